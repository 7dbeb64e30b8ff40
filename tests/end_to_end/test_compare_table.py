"""What compare prints of many conditions: the pooled scores, and where the others are."""

from __future__ import annotations

from tests.end_to_end.conftest import Bench, small_grasps


def test_of_many_conditions_the_pooled_scores_are_printed_and_all_are_in_the_report(bench: Bench) -> None:
    folder = bench.path / "many"
    folder.mkdir()
    for k in range(5):
        samples, meta = small_grasps(100 * k)
        (folder / f"condition{k}.csv").write_text(samples, encoding="utf-8")
        (folder / f"condition{k}_meta.csv").write_text(meta, encoding="utf-8")
    words = ["--classifiers", "features-lda", "--repeats", "1", "--out", "c"]
    done = bench.run("compare", folder, *words)
    assert done.code == 0
    assert "pooled" in done.out
    assert "5 conditions, one by one in the report" in done.out
    assert "condition3" not in done.out
    assert "condition3" in (bench.path / "c" / "report.html").read_text(encoding="utf-8")
    few = bench.run("compare", folder / "condition0.csv", folder / "condition3.csv", *words)
    assert "condition3" in few.out
