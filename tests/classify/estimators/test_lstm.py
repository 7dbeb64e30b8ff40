"""The network is the paper's, trains inside its fold, and is the same for the same seed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thermogrip.classify import make_classifier
from thermogrip.classify.estimators.base import GraspClassifier, pick
from thermogrip.classify.estimators.lstm import augment
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

Tiny = Callable[..., GraspClassifier]


def test_the_defaults_are_the_papers() -> None:
    network = make_classifier("lstm")
    assert (network.hidden, network.epochs, network.batch, network.series_per_class) == (32, 2000, 100, 100)
    assert make_classifier("lstm", quick=True).epochs == 200
    assert make_classifier("lstm-paper").patience is None  # all 2000 epochs
    for n in (3, 5):  # one grasp a material becomes the paper's 300 and 500 series
        assert augment(np.zeros((n, 10)), [f"m{i}" for i in range(n)]).traces.shape == (100 * n, 10)


def test_copies_are_their_source_plus_one_shift_plus_white_noise() -> None:
    real = np.random.default_rng(0).normal(30, 3, (6, 400))
    made = augment(real, list("aabbcc"), series_per_class=200, noise_sd=0.05, shift_sd=0.3, seed=1)
    rest = made.traces - real[made.source]
    assert rest.mean(axis=1).std() == pytest.approx(0.3, rel=0.1)
    assert (rest - rest.mean(axis=1, keepdims=True)).std() == pytest.approx(0.05, rel=0.02)
    assert np.array_equal(made.labels, np.array(list("aabbcc"))[made.source])
    assert np.bincount(made.source).tolist() == [100] * 6
    noise = rest - rest.mean(axis=1, keepdims=True)
    lag_one = (noise[:, 1:] * noise[:, :-1]).mean() / noise.var()
    assert abs(lag_one) < 4 / np.sqrt(noise.size)


def test_a_copy_never_leaves_its_fold(
    three: Grasps, make_tiny_lstm: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every row that a fit augments is a row of its own training grasps; prediction augments nothing."""
    from thermogrip.classify import evaluate
    from thermogrip.classify.estimators import lstm

    seen: list[np.ndarray] = []

    def spy(traces: np.ndarray, labels: np.ndarray, **rest: object) -> object:
        seen.append(np.array(traces))
        return augment(traces, labels, **rest)  # type: ignore[arg-type]

    monkeypatch.setattr(lstm, "augment", spy)
    evaluate(
        {"lstm": make_tiny_lstm(epochs=1)}, [three], split="random", repeats=2, train_per_class=5, probe=False
    )
    from thermogrip.classify.evaluation.splits import plan_folds

    folds = plan_folds([three], split="random", repeats=2, train_per_class=5).folds
    assert len(seen) == len(folds) == 2
    start = three.sizes["time"] - seen[0].shape[1]
    for traces, fold in zip(seen, folds):
        np.testing.assert_allclose(traces, fold.train["t_surface"].values[:, start:])
        test = fold.test["t_surface"].values[:, start:]
        assert np.abs(traces[:, None, :] - test[None, :, :]).max(axis=2).min() > 0.01


def test_a_seed_is_a_network_and_another_is_another(three: Grasps, make_tiny_lstm: Tiny) -> None:
    fits = [make_tiny_lstm(epochs=3, random_state=seed).fit(three) for seed in (1, 1, 2)]
    p = [f.predict_proba(three) for f in fits]
    assert np.array_equal(p[0], p[1])
    assert not np.allclose(p[0], p[2])
    assert np.array_equal(fits[0].loss_curve_, fits[1].loss_curve_)


def test_training_leaves_global_random_state_and_threads_alone(three: Grasps, make_tiny_lstm: Tiny) -> None:
    import torch

    torch.manual_seed(7)
    expected = torch.rand(1)
    torch.manual_seed(7)
    threads = torch.get_num_threads()
    make_tiny_lstm(epochs=1).fit(three)
    assert torch.equal(torch.rand(1), expected)
    assert torch.get_num_threads() == threads


def test_the_loss_falls(three: Grasps, make_tiny_lstm: Tiny) -> None:
    curve = make_tiny_lstm().fit(three).loss_curve_
    assert curve.shape == (100,)
    assert curve[0] == pytest.approx(np.log(3), abs=0.2)  # an untrained network guesses
    assert curve[-10:].mean() < 0.3 * curve[0]


def test_the_network_is_the_recurrence_of_its_docstring(three: Grasps, make_tiny_lstm: Tiny) -> None:
    model = make_tiny_lstm(epochs=2).fit(three)
    one = pick(three, [0])
    x = (one["t_surface"].values[0, -model.times_.size :] - model.mean_) / model.sd_
    w = {k: v.astype(float) for k, v in model.weights_.items()}
    h = c = np.zeros(model.hidden)
    for value in x:
        gates = (
            w["lstm.weight_ih_l0"][:, 0] * value
            + w["lstm.bias_ih_l0"]
            + w["lstm.weight_hh_l0"] @ h
            + w["lstm.bias_hh_l0"]
        )
        i, f, g, o = np.split(gates, 4)
        squash = lambda z: 1 / (1 + np.exp(-z))  # noqa: E731
        c = squash(f) * c + squash(i) * np.tanh(g)
        h = squash(o) * np.tanh(c)
    logits = w["readout.weight"] @ h + w["readout.bias"]
    expected = np.exp(logits - logits.max())
    np.testing.assert_allclose(model.predict_proba(one)[0], expected / expected.sum(), atol=1e-5)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"epochs": 0}, "cannot train with"),
        ({"hidden": 0}, "cannot train with"),
        ({"learning_rate": -1.0}, "cannot train with"),
        ({"feed": "rise"}, "feed is 'rise'; use each_time or trace"),
        ({"device": "tpu"}, "device is 'tpu'; use auto, cpu or cuda"),
        ({"noise_sd": -0.1}, "cannot augment"),
        ({"patience": 0}, "patience is 0; use at least 1 epoch"),
    ],
)
def test_wrong_params_are_refused(
    three: Grasps, make_tiny_lstm: Tiny, bad: dict[str, object], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        make_tiny_lstm(**bad).fit(three)


def test_a_missing_gpu_is_an_error(
    three: Grasps, make_tiny_lstm: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)  # also where there is one
    with pytest.raises(UserError, match="PyTorch finds no GPU; use device cpu or auto"):
        make_tiny_lstm(device="cuda").fit(three)


def test_training_ends_where_held_out_grasps_gain_no_more(three: Grasps, make_tiny_lstm: Tiny) -> None:
    short, long = (make_tiny_lstm(epochs=n, patience=15).fit(three) for n in (15, 1000))
    assert short.loss_curve_.size == 15  # what is no longer than the patience cannot end before it is over
    assert 15 < long.loss_curve_.size < 900
    as_long = make_tiny_lstm(epochs=long.loss_curve_.size, patience=None).fit(three)
    np.testing.assert_array_equal(as_long.loss_curve_, long.loss_curve_)  # on all grasps, for as many epochs


def test_all_epochs_are_trained_where_no_grasp_can_be_held_out(three: Grasps, make_tiny_lstm: Tiny) -> None:
    labels = three["material"].values.astype(str)
    alone = pick(three, [int(np.argmax(labels == name)) for name in np.unique(labels)])
    assert make_tiny_lstm(epochs=30, patience=2).fit(alone).loss_curve_.size == 30


def test_the_papers_feed_has_one_scale_and_ours_one_for_each_time(three: Grasps) -> None:
    short: dict[str, object] = {"epochs": 1, "hidden": 4, "series_per_class": 5}
    paper = make_classifier("lstm-paper", **short).fit(three)
    ours = make_classifier("lstm", **short).fit(three)
    assert np.unique(paper.mean_).size == np.unique(paper.sd_).size == 1
    assert np.unique(ours.mean_).size == ours.times_.size
