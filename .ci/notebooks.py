"""Run the notebooks, each in a folder of its own, and write what they show for the docs site.

    python .ci/notebooks.py [NAME...]       from notebooks/NAME.py to build/notebooks/NAME.md and its figures

A cell that raises ends it with the traceback.  Needs the extra ``docs``.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import jupytext
from nbclient import NotebookClient
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[1]
OUT = ROOT / "build" / "notebooks"


def main() -> None:
    """Run those that are named, or all."""
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"
    OUT.mkdir(parents=True, exist_ok=True)
    for source in sorted((ROOT / "notebooks").glob("*.py")):
        if sys.argv[1:] and source.stem not in sys.argv[1:]:
            continue
        began = time.monotonic()
        notebook = jupytext.read(source)
        with tempfile.TemporaryDirectory() as folder:
            NotebookClient(notebook, timeout=300, resources={"metadata": {"path": folder}}).execute()
        for cell in notebook.cells:
            for output in cell.get("outputs", []):  # xarray brings 20 kB of styles; its text says the same
                if "xr-wrap" in output.get("data", {}).get("text/html", ""):
                    del output["data"]["text/html"]
        text, resources = MarkdownExporter().from_notebook_node(
            notebook, resources={"output_files_dir": "", "unique_key": source.stem}
        )
        for name, content in resources["outputs"].items():
            (OUT / Path(name).name).write_bytes(content)
        # a table without a class scrolls in a narrow window, as the site's own do
        text = text.replace('<table border="1" class="dataframe">', "<table>")
        (OUT / f"{source.stem}.md").write_text(text, encoding="utf-8")
        cells = sum(cell.cell_type == "code" for cell in notebook.cells)
        sys.stdout.write(f"{source.name}: {cells} cells ran in {time.monotonic() - began:.0f} s\n")


if __name__ == "__main__":
    main()
