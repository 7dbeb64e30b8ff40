"""Compare a wheel's files with the tree: what setup.py does not find is missing silently."""

import sys
import zipfile
from pathlib import Path

ROOMS = {
    "src/thermogrip": "thermogrip",
    **{r: f"thermogrip/{r}" for r in ["datasets", "sysid", "mpc", "rig", "classify"]},
}


def tree_files() -> set[str]:
    """Return the paths that an installed package must have."""
    found = set()
    for folder, package in ROOMS.items():
        for path in Path(folder).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".pyc":
                found.add(f"{package}/{path.relative_to(folder).as_posix()}")
    return found


def main() -> int:
    """Return 0 where wheel and tree agree."""
    with zipfile.ZipFile(sys.argv[1]) as wheel:
        packed = {name for name in wheel.namelist() if ".dist-info/" not in name}
    tree = tree_files()
    for name in sorted(tree - packed):
        sys.stdout.write(f"not in the wheel: {name}\n")
    for name in sorted(packed - tree):
        sys.stdout.write(f"not in the tree: {name}\n")
    sys.stdout.write(f"{len(packed)} files in the wheel, {len(tree)} in the tree\n")
    return int(tree != packed)


if __name__ == "__main__":
    raise SystemExit(main())
