"""The explicit law is the program's solution, found without solving it."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.optimiser.qp import CondensedQP
from thermogrip.mpc.plant.explicit import ExplicitLaw, explicit_law


@pytest.fixture(scope="module")
def controller(tank) -> Controller:
    return design_controller(tank, dt=2.0, blocks=(1, 3, 16), move=30.0)


@pytest.fixture(scope="module")
def law(controller) -> ExplicitLaw:
    return explicit_law(controller)


def solved(controller: Controller, law: ExplicitLaw, f: np.ndarray, last: np.ndarray) -> np.ndarray:
    optimiser, n = controller.optimiser, len(f)
    span = controller.model.span[0]
    A = np.vstack([np.eye(n), optimiser.differences])
    before = np.zeros(n)
    before[0] = last[0]
    lower = np.concatenate([np.full(n, optimiser.lowest[0]), before - optimiser.slews]) / span
    upper = np.concatenate([np.full(n, optimiser.highest[0]), before + optimiser.slews]) / span
    none = np.zeros(2 * n)
    answer = CondensedQP(soft=none > 0, linear=none, quadratic=none).solve(law.H, f, A, lower, upper)
    assert answer.solved
    return answer.x


def test_at_random_states_the_table_is_the_solution(controller, law):
    rng = np.random.default_rng(3)
    seen = set()
    for _ in range(300):
        last = rng.uniform(-1, 1, 1)
        f = -law.H @ rng.normal(size=3) * 10 ** rng.uniform(-2, 0.7)
        plan = law.plan(f, last)
        np.testing.assert_allclose(plan, solved(controller, law, f, last), atol=1e-7)
        p = np.concatenate([f, last / law.span])
        seen.add(min(law.regions, key=lambda r: float(np.max(r.rows @ p - r.bounds))).active)
    assert len(seen) > 8
    assert () in seen  # the one without any limit, which is the linear law


def test_regions_do_not_overlap_and_leave_no_hole(law):
    rng = np.random.default_rng(4)
    for _ in range(200):
        p = np.concatenate([3 * law.H @ rng.normal(size=3), rng.uniform(-0.5, 0.5, 1)])
        inside = [r for r in law.regions if np.max(r.rows @ p - r.bounds) < -1e-9]
        touching = [r for r in law.regions if np.max(r.rows @ p - r.bounds) < 1e-9]
        assert len(inside) <= 1
        assert touching


def test_the_middle_region_is_the_linear_move(controller, law):
    middle = next(region for region in law.regions if not region.active)
    np.testing.assert_allclose(middle.gain[:, :3], -np.linalg.inv(law.H), atol=1e-12)
    np.testing.assert_allclose(middle.gain[:, 3:], 0.0, atol=1e-12)


def test_the_law_moves_as_the_controller_does(controller, law):
    from thermogrip.mpc.controllers.linear_equivalent import augmented

    n_z = len(augmented(controller)[0])
    rng, room = np.random.default_rng(5), np.array([25.0])
    about = {"side": np.zeros(1), "bias": np.zeros(2), "drive_bias": np.zeros(1)}
    for _ in range(20):
        x = controller.model.rest(25 + rng.normal(size=2), room)
        z = np.concatenate([x - controller.model.rest(np.full(2, 25.0), room), np.zeros(n_z - len(x))])
        last, target = rng.uniform(-1, 1, 1), rng.normal(size=1) * 3
        found = controller.optimiser.solve(
            x, last, np.repeat(last[None], 3, 0), room, target=25 + target, **about
        )
        f = law.program(z, target, np.zeros(1), last)
        np.testing.assert_allclose(law.drive(f, last), found.plan[0], atol=1e-6)


def test_a_plan_of_many_blocks_is_refused_with_what_to_do(tank):
    with pytest.raises(UserError, match=r"10 blocks of 1 drives have \d+ sets") as caught:
        explicit_law(design_controller(tank, dt=2.0))
    assert "fewer blocks" in str(caught.value)
