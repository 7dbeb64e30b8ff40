"""What a Dask worker does before it takes work, however its preload is named."""

from __future__ import annotations

import gc
import math
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from thermogrip.cli import classify, cluster, compare
from thermogrip.datasets.parallel import run_parallel

NAME = "thermogrip.cli.cluster"


@pytest.fixture(autouse=True)
def thawed() -> Iterator[None]:
    """Give back what a worker in this process left out of searches for garbage."""
    yield
    gc.unfreeze()


def test_what_tasks_need_is_imported_and_what_slows_them_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    callbacks = dict.fromkeys(("heartbeat", "profile", "profile-cycle"), "each some milliseconds")
    found: list[str] = []
    monkeypatch.setattr(cluster, "import_module", found.append)
    before = gc.get_freeze_count()
    cluster.dask_setup(SimpleNamespace(periodic_callbacks=callbacks))
    assert found == [*cluster.MODULES]
    assert {*classify.NEEDED, *compare.NEEDED} < {*found}
    assert [*callbacks] == ["heartbeat"]
    assert gc.get_freeze_count() > before
    cluster.dask_setup(SimpleNamespace(periodic_callbacks=callbacks))  # a worker that has no profiler


@pytest.mark.parametrize("way", ["argument", "environment"])
def test_a_worker_of_dask_takes_it_as_its_preload(way: str) -> None:
    distributed = pytest.importorskip("distributed")
    import dask

    options: dict[str, Any] = {"preload": [NAME]} if way == "argument" else {}
    named = dask.config.collect_env({"DASK_DISTRIBUTED__WORKER__PRELOAD": NAME})["distributed"]["worker"]
    with (
        dask.config.set({} if options else {"distributed.worker.preload": named["preload"]}),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", host="127.0.0.1",
            dashboard_address=":0", **options,
        ) as made,
    ):  # fmt: skip
        [worker] = made.workers.values()
        assert "heartbeat" in worker.periodic_callbacks
        assert not {"profile", "profile-cycle"} & {*worker.periodic_callbacks}
        assert {*cluster.MODULES} <= {*sys.modules}
        assert run_parallel(math.factorial, [3, 4, 5], made.scheduler_address) == [6, 24, 120]
