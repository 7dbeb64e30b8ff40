"""What two touches identify, and how soon one touch is enough: every figure of the docs in one command.

    OMP_NUM_THREADS=1 python benchmarks/classify/touches.py [--splits 20] [--parts two,truth]

- two: bundled groups (exp5), object temperature unknown, three groups of a material train and three test: the
  shipped split, and random splits by group;
- truth: the same on grasps by finite volumes (finite_volumes.py), where the temperature is known;
- elsewhere: the same, taught by rests of 60 s, after other rests, in other rooms and for other blocks
  (--seed, --repeats of each material);
- early: random splits by grasp of exp1A and exp2 dT 10 to 20; the gripper and both thresholds from the
  training part alone, calibrated without a start;
- next: the expected accuracy of a second touch, and the measured one;
- stream: time of a sample;
- figures: those of docs/explanation/decisions.md, from the shipped split, into --out.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import finite_volumes as fv
import numpy as np
from scipy.special import logsumexp

from thermogrip.classify import make_classifier
from thermogrip.classify.decisions.next_touch import choose_next_touch
from thermogrip.classify.decisions.stopping_rule import (
    StopRule,
    Stream,
    Windows,
    growing_windows,
    learn_from_windows,
    silent_windows,
    stops,
)
from thermogrip.classify.estimators.base import pick
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.classify.evaluation.splits import plan_folds
from thermogrip.classify.figures import PALETTE
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.materials import find_material
from thermogrip.datasets.media import panels as grid_of
from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.multi_touch import learn_coupling, touch_groups, two_touch_fit
from thermogrip.sysid.effusivity.posterior import effusivity_posterior, material_fit

TWO = "exp5_two_touch_unknown_object"
EARLY = ("exp1A_obj43_grip23", "exp2_dT10", "exp2_dT15", "exp2_dT20")
COARSE = {"wood": "wood", "acrylic": "acrylic"}  # everything else is metal


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--splits", type=int, default=20)
    parser.add_argument("--parts", default="two,truth,elsewhere,next,stream,early")
    parser.add_argument("--out", default="docs/explanation")
    parser.add_argument("--seed", type=int, default=600, help="of the grasps of the part elsewhere")
    parser.add_argument("--repeats", type=int, default=8, help="test blocks of each material there")
    args = parser.parse_args()
    global OUT, SEED, REPEATS
    OUT, SEED, REPEATS = Path(args.out), args.seed, args.repeats
    files = load_example_grasps()
    for part in args.parts.split(","):
        start = time.perf_counter()
        PARTS[part](files, args.splits)
        print(f"  ({time.perf_counter() - start:.0f} s)\n", flush=True)


def two(files, splits):
    """Bundled groups: one touch, two touches independent, two touches joint."""
    record = files[TWO]
    base = [pick(r, r["split"].values == "train") for n, r in sorted(files.items()) if n[:4] in SINGLE]
    shipped = set(record["touch_group"].values[record["split"].values == "train"].tolist())
    trained = [shipped, *(_random_groups(record, seed) for seed in range(min(splits, 8)))]
    rows = [_two_once(record, base, train) for train in trained]
    print(
        f"two touches, temperature unknown, n = {rows[0]['n']} groups shipped, {len(rows) - 1} random splits"
    )
    print("  | | eight | metal/wood/acrylic | log loss | stated confidence |")
    for name in ("pca-lda on both traces", "one touch", "two, taken as independent", "two, joint"):
        for label, some in (("shipped", rows[:1]), ("random", rows[1:])):
            if some:
                v = np.mean([row[name] for row in some], axis=0)
                print(f"  {name}, {label}: {v[0]:.2f} {v[1]:.2f} {v[2]:.2f} {v[3]:.2f}")
    print("  coupling, shipped:", rows[0]["coupling"])


SINGLE = ("exp1", "exp2", "exp3", "exp4")


def _random_groups(record, seed):
    rng = np.random.default_rng(seed)
    rows = touch_groups(record)
    label = {name: str(record["material"].values[at[0]]) for name, at in rows.items()}
    chosen = set()
    for material in sorted(set(label.values())):
        own = [name for name in rows if label[name] == material]
        chosen |= set(rng.permutation(own)[:3].tolist())
    return chosen


def _two_once(record, base, train_groups):
    there = np.isin(record["touch_group"].values.astype(str), list(train_groups))
    train, test = pick(record, there), pick(record, ~there)
    # the bundled calibration saw no grasp of this file, so it is a fair start
    device = calibrate_gripper([*base, train], start=load_default_gripper())
    coupling = learn_coupling(device, train)
    names = sorted(set(record["material"].values.tolist()))
    fit = two_touch_fit(device, test, names, coupling=coupling)
    true = np.array([names.index(str(test["material"].values[at[0]])) for at in fit.rows])
    single = material_fit(device, test.drop_vars("touch_group"), names).log_evidence
    first, second = (np.array([at[k] for at in fit.rows]) for k in (0, 1))
    return {
        "n": true.size,
        "coupling": coupling,
        "pca-lda on both traces": _scored(_pca_lda(train, test, names), true, names),
        "one touch": _scored(single[first], true, names),
        "two, taken as independent": _scored(single[first] + single[second], true, names),
        "two, joint": _scored(fit.log_evidence, true, names),
    }


def _pca_lda(train, test, names):
    def paired(record):
        rows = list(touch_groups(record).values())
        one, other = (np.array([at[k] for at in rows]) for k in (0, 1))
        traces = record["t_surface"].values
        return make_grasps(
            record["time"].values, traces[one], record["grasp"].values[one],
            material=record["material"].values[one], t_surface_2=traces[other],
        )  # fmt: skip

    model = make_classifier("pca-lda").fit(paired(train))
    return model.candidate_log_proba(paired(test), names)


def _scored(log_z, true, names):
    """Return accuracy, accuracy of the three groups, log loss and mean confidence."""
    log_p = log_z - logsumexp(log_z, axis=1, keepdims=True)
    group = np.array([COARSE.get(name, "metal") for name in names])
    best = log_p.argmax(axis=1)
    loss = -log_p[np.arange(true.size), true]
    return (
        float((best == true).mean()),
        float((group[best] == group[true]).mean()),
        float(loss.mean()),
        float(np.exp(log_p.max(axis=1)).mean()),
    )


def truth(files, splits):
    """Groups by finite volumes: materials, and the temperature that the files of a rig do not hold.

    Training and test are drawn anew for each seed; start and widths were chosen with seeds 1 to 4 in view.
    """
    del files, splits
    names = list(fv.EIGHT)
    found = []
    for seed in FRESH:
        single, (train, _) = fv.labelled(seed=seed), fv.touched_twice(seed=seed + 1)
        # from the bundled gripper, another one altogether: from nothing the fit can end in a poorer optimum
        device = calibrate_gripper([*single, train], start=load_default_gripper())
        coupling = learn_coupling(device, train)
        found.append(_truth_once(device, coupling, names, seed + 2))
        print(f"  seed {seed}: {_truth_line([found[-1]])}", flush=True)
    print(f"finite volumes, {len(found)} seeds: {_truth_line(found)}")
    each = np.array([[acc.mean(), group.mean()] for acc, group, *_ in found])
    error = each.std(axis=0, ddof=1) / np.sqrt(len(found))
    print(f"  standard error over seeds: eight {error[0]:.3f}, metal/wood/acrylic {error[1]:.3f}")


FRESH = range(100, 160, 10)
ELSEWHERE = {
    "as in the training": {},
    "rest 5 s": {"rest": 5.0},
    "rest 300 s": {"rest": 300.0},
    "rest 1200 s": {"rest": 1200.0},
    "blocks at 45 to 60 degC": {"t_object": (45.0, 60.0)},
    "blocks at 0 to 15 degC": {"t_object": (0.0, 15.0)},
    "room at 5 degC": {"t_room": (5.0, 6.0)},
    "blocks that lose three times as much": {"rig": fv.Rig(far=50.0, sides=30.0)},
    "that, rest 300 s": {"rig": fv.Rig(far=50.0, sides=30.0), "rest": 300.0},
    "blocks that lose 2.2 times as much": {"rig": fv.Rig(far=33.0, sides=22.0)},
    "blocks that lose half": {"rig": fv.Rig(far=7.5, sides=5.0)},
}


def elsewhere(files, splits):
    """Names, and 90 % intervals of effusivity and temperature, of groups unlike those of the training."""
    del files, splits
    training = [*fv.labelled(fv.EIGHT, repeats=5, seed=SEED), fv.touched_twice(seed=SEED + 1)[0]]
    known = PosteriorClassifier(device=load_default_gripper()).fit(training)
    names = known.classes_.tolist()
    for what, how in ELSEWHERE.items():
        test, t_true = fv.touched_twice(repeats=REPEATS, seed=SEED + 2, **how)
        label = test["material"].values[: t_true.size].tolist()
        fit = two_touch_fit(known.device_, test, names, coupling=known.coupling_)
        p = np.exp(fit.log_evidence - logsumexp(fit.log_evidence, axis=1, keepdims=True))
        found = effusivity_posterior(known.device_, test, coupling=known.coupling_)[: t_true.size]
        e = np.array([find_material(name).effusivity for name in label])
        inside = [
            np.mean([row.effusivity_p05 <= x <= row.effusivity_p95 for row, x in zip(found, e)]),
            np.mean([row.t_object_p05 <= x <= row.t_object_p95 for row, x in zip(found, t_true)]),
        ]
        right = np.mean(np.array(names)[p.argmax(axis=1)] == label)
        print(
            f"  {what}: right {right:.2f}, stated {p.max(axis=1).mean():.2f}; 90 % intervals of e hold",
            end=" ",
        )
        print(f"{inside[0]:.2f}, of T_obj {inside[1]:.2f} (n = {t_true.size});", end=" ")
        print(f"loss {np.median(fit.loss):.2f} of the training's", flush=True)


def _truth_line(found):
    acc, group, error, inside, metal = (np.concatenate([f[k] for f in found]) for k in range(5))
    parts = [f"n = {acc.size}, eight {acc.mean():.3f}, metal/wood/acrylic {group.mean():.3f}"]
    for label, at in (("metals", metal), ("others", ~metal)):
        rms, bias = np.sqrt((error[at] ** 2).mean()), error[at].mean()
        parts.append(f"T_obj of {label} rms {rms:.2f} degC (bias {bias:+.2f}, n = {at.sum()})")
    return "; ".join([*parts, f"90 % intervals cover {inside.mean():.2f}"])


def _truth_once(device, coupling, names, seed):
    test, t_true = fv.touched_twice(seed=seed, repeats=8)
    fit = two_touch_fit(device, test, names, coupling=coupling)
    label = test["material"].values[[at[0] for at in fit.rows]].astype(str)
    p = np.exp(fit.log_evidence - logsumexp(fit.log_evidence, axis=1, keepdims=True))
    mean = (p * fit.t_object).sum(axis=1)
    sd = np.sqrt((p * (fit.t_object_sd**2 + (fit.t_object - mean[:, None]) ** 2)).sum(axis=1))
    error = mean - t_true
    answer = np.array(names)[p.argmax(axis=1)]
    same = np.array([COARSE.get(a, "metal") == COARSE.get(b, "metal") for a, b in zip(answer, label)])
    return answer == label, same, error, np.abs(error) < 1.645 * sd, ~np.isin(label, list(COARSE))


def next_touch(files, splits):
    """Expected accuracy of a second touch at the temperature that was used, and the measured one."""
    del splits
    record = files[TWO]
    base = [pick(r, r["split"].values == "train") for n, r in sorted(files.items()) if n[:4] in SINGLE]
    train, test = (pick(record, record["split"].values == s) for s in ("train", "test"))
    device = calibrate_gripper([*base, train], start=load_default_gripper())
    known = PosteriorClassifier().with_device(device, learn_coupling(device, train))
    fit = two_touch_fit(device, test, list(known.classes_), coupling=known.coupling_)
    rows = []
    for at, evidence in zip(fit.rows, fit.log_evidence):
        one, used = pick(test, at[:1]), float(test["t_gripper"].values[at[1]])
        choice = choose_next_touch(known, one, t_gripper=[used, *np.arange(12.5, 50.1, 2.5)])
        truth = list(known.classes_).index(str(one["material"].values[0]))
        rows.append(
            (choice.accuracy_now, choice.accuracy[0], evidence.argmax() == truth, choice.accuracy.max())
        )
    now, predicted, found, best = np.mean(rows, axis=0)
    print(f"second touch, n = {len(rows)}: expected accuracy before {now:.2f}, after {predicted:.2f}")
    print(f"  found {found:.2f}; expected at the best temperature {best:.2f}")


def stream(files, splits):
    """Time of one sample, five candidates."""
    del splits
    known = PosteriorClassifier().with_device(load_default_gripper())
    cost = []
    for i in range(0, 40, 4):
        grasp = pick(files["exp1A_obj43_grip23"], [i])
        touch = Stream(known, t_object=43.0, t_ambient=float(grasp["t_ambient"].values[0]))
        for t, y in zip(grasp["time"].values, grasp["t_surface"].values[0]):
            start = time.process_time()
            touch.update(float(t), float(y))
            if t > 0.3:
                cost.append(1e3 * (time.process_time() - start))
    median, late = np.quantile(cost, [0.5, 0.95])
    print(f"stream, five candidates: {median:.1f} ms a sample, 95 % below {late:.1f} ms")


def early(files, splits):
    """Early stops on random splits by grasp."""
    records = [files[n] for n in sorted(files) if n[:4] in SINGLE]
    plan = plan_folds(records, split="random", repeats=splits, seed=0)
    seen = {name: [] for name in EARLY}
    for repeat, training in enumerate(plan.training):
        known = PosteriorClassifier().with_device(calibrate_gripper(list(training)))
        for fold in plan.folds:
            if fold.repeat == repeat and fold.condition in EARLY:
                parts = []
                for part in (fold.train, fold.test):
                    windows = growing_windows(known, part, candidates=fold.candidates)
                    true = np.array([fold.candidates.index(m) for m in part["material"].values])
                    parts.append((windows, true, silent_windows(part, windows.times)))
                seen[fold.condition].append(parts)
        print(f"  split {repeat + 1} of {splits}", flush=True)
    print("early stops, mean over splits; thresholds from the training grasps of these four files")
    for error, loss in ((0.05, 0.01), (0.04, 0.01), (0.03, 0.01), (0.03, 0.0)):
        _early_table(seen, splits, error, loss)


def _early_table(seen, splits, error, loss):
    rows = {name: [] for name in EARLY}
    for repeat in range(splits):
        rule = learn_from_windows([seen[name][repeat][0][:2] for name in EARLY], error=error, loss=loss)
        for name in EARLY:
            rows[name].append(_early_once(rule, *seen[name][repeat][1]))
    print(f"  stated error {error:g}, loss {loss:g}")
    for name, found in rows.items():
        v = np.array(found)
        wrong = v[:, 3].sum() / max(v[:, 4].sum(), 1)
        mean = v[:, :3].mean(axis=0)
        print(f"    {name}: {mean[0]:.3f} at {mean[1]:.2f} s on average, {mean[2]:.3f} at 10 s;", end=" ")
        print(f"wrong among the sure {wrong:.3f}")


def _early_once(rule: StopRule, windows: Windows, true, silent):
    found = stops(rule, windows, silent)
    sure = found.early & found.confident
    return (
        float((found.answer == true).mean()),
        float(found.time.mean()),
        float((windows.log_p[:, -1].argmax(axis=1) == true).mean()),
        int((sure & (found.answer != true)).sum()),
        int(sure.sum()),
    )


def figures(files, splits):
    """Draw what the page on decisions shows, with the bundled calibration and the shipped test grasps."""
    del splits
    known = PosteriorClassifier().with_device(load_default_gripper())
    train, test = {}, {}
    for name in EARLY:
        names = sorted(set(files[name]["material"].values.tolist()))
        for split, into in (("train", train), ("test", test)):
            part = pick(files[name], files[name]["split"].values == split)
            true = np.array([names.index(m) for m in part["material"].values])
            into[name] = (growing_windows(known, part, candidates=names), true)
    rule = learn_from_windows(list(train.values()), error=0.04)
    record = files[TWO]
    choices = {}
    for row in (24, 28, 35):
        label = f"{record['material'].values[row]}, first touched at {record['t_gripper'].values[row]:g}"
        choices[label] = choose_next_touch(known, pick(record, [row]))
    drawn = {
        "stop_times": stop_time_figure(rule, test),
        "contact_time": contact_time_figure({n: test[n] for n in (EARLY[0], EARLY[-1])}),
        "next_touch": next_touch_figure(choices),
    }
    for name, figure in drawn.items():
        figure.savefig(OUT / f"{name}.{FORMAT}", metadata={"Date": None} if FORMAT == "svg" else None)
    print(f"wrote three figures to {OUT}; {rule}")


def contact_time_figure(conditions):
    """Draw accuracy and stated confidence against contact time, a panel a condition."""
    figure, axes = panels(len(conditions))
    for axis, (name, (seen, true)) in zip(axes, conditions.items()):
        right = (seen.log_p.argmax(axis=2) == true[:, None]).mean(axis=0)
        stated = np.exp(seen.log_p.max(axis=2)).mean(axis=0)
        axis.plot(seen.times, right, "o-", ms=3.5, color=PALETTE[0], label="accuracy")
        axis.plot(seen.times, stated, "s--", ms=3, color=PALETTE[1], label="stated confidence")
        axis.set_title(f"{name}, n = {true.size}", fontsize=9)
        over_time(axis)
        axis.set(ylim=(0, 1.03))
    axes[0].legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def stop_time_figure(rule, conditions):
    """Draw the share of contacts that a rule has ended by each time, and where it named the wrong
    material."""
    figure, [[axis]] = grid_of(1, 1, size=(6.4, 3.4), ticks=7)
    for k, (name, (seen, true)) in enumerate(conditions.items()):
        found = stops(rule, seen)
        order = np.argsort(found.time, kind="stable")
        share = (np.arange(true.size) + 1) / true.size
        label = f"{name}: {found.time.mean():.1f} s on average"
        start = np.concatenate([[seen.times[0]], found.time[order]])
        axis.step(start, np.concatenate([[0.0], share]), where="post", color=PALETTE[k % 8], label=label)
        wrong = (found.answer != true)[order]
        axis.plot(found.time[order][wrong], share[wrong], "x", color=PALETTE[k % 8], ms=6)
    axis.plot([], [], "x", color="#1d2733", label="named wrong")
    over_time(axis)
    axis.set(ylabel="share of contacts ended", ylim=(0, 1.03))
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    return figure


def next_touch_figure(choices):
    """Draw expected information and accuracy of another touch against the gripper's temperature."""
    figure, axes = panels(2)
    for k, (name, choice) in enumerate(choices.items()):
        color = PALETTE[k % 8]
        axes[0].plot(choice.t_gripper, choice.information, "-", color=color, label=name)
        axes[1].plot(choice.t_gripper, choice.accuracy, "-", color=color)
        axes[1].axhline(choice.accuracy_now, color=color, lw=0.8, ls=":")
    axes[0].set(xlabel="gripper in the next touch [degC]", ylabel="expected information [nat]")
    axes[1].set(xlabel="gripper in the next touch [degC]", ylabel="expected accuracy", ylim=(0, 1.03))
    axes[1].set_title("dotted: without it", fontsize=8, color="#1d2733")
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    return figure


def over_time(axis):
    """Give an axis a logarithmic scale of contact times."""
    axis.set(xscale="log", xlabel="contact time [s]")
    axis.set_xticks([0.3, 1, 3, 10], ["0.3", "1", "3", "10"])
    axis.minorticks_off()


def panels(count):
    """Return a figure and its axes in a row."""
    figure, axes = grid_of(1, count, size=(3.2 * count, 3.0), ticks=7)
    return figure, axes[0]


OUT, FORMAT = Path(), "svg"
PARTS = {
    "figures": figures,
    "two": two,
    "truth": truth,
    "elsewhere": elsewhere,
    "early": early,
    "next": next_touch,
    "stream": stream,
}

if __name__ == "__main__":
    main()
