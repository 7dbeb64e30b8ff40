"""Mistakes as people type them, in a folder of small files, and what mends each."""

from __future__ import annotations

import lzma
from pathlib import Path

from tests.end_to_end.conftest import HEADER, small_grasps, small_log_rows, small_plant

OWN = """
class Tank:
    def rhs(self, x, u, d, p):
        return x
"""
PLAN = "material,t_object_degC,target_degC\nwood,23,38\n"

#: What is typed -> the mend, which the line has.
MISTAKES = {
    # verbs and options
    "identfy log.csv": "Did you mean 'identify'",
    "valdiate plant.json log.csv": "Did you mean 'validate'",
    "clasify model grasps.csv --out p.csv": "Did you mean 'classify'",
    "identify log.csv --input drive": "did you mean '--inputs'?",
    "tune plant.json --ot c.json": "did you mean '--out'?",
    "run controller.json --traget 38 --twin plant.json --out r": "did you mean '--target'?",
    "classify model grasps.csv --nearset --out p.csv": "did you mean '--nearest'?",
    "compare grasps.csv --classifer bayes --out c": "did you mean '--classifiers'?",
    "warmup": "Did you mean 'warm-up'",
    "export controller.json --out fw --chekc": "did you mean '--check'?",
    "identify log.csv -o plant.json": "options are whole words: --out, ",
    "identify log.csv --seed one": "Invalid value for '--seed'",
    # networks, models, classifiers
    "identify log.csv --network griper": "did you mean 'gripper'?",
    "excite --kind prbs --minutes 5 --network tclb --out s.csv": "did you mean 'tclab'?",
    "init network --like tclba": "did you mean 'tclab'?",
    "identify log.csv --network net.tml": "did you mean 'net.toml'?",
    "identify log.csv --network own.py:Tnak": "did you mean 'Tank'?",
    "identify log.csv --network onw.py:Tank": "did you mean 'own.py'?",
    "identify log.csv --models arx,subspce": "did you mean 'subspace'?",
    "identify log.csv --models netwrok": "did you mean 'network'?",
    "train grasps.csv --classifier baeys --out m": "did you mean 'bayes'?",
    "compare grasps.csv --classifiers posterior,pca_lda --out c": "did you mean 'pca-lda'?",
    "compare grasps.csv --classifiers bayes+postrior --out c": "did you mean 'posterior'?",
    # materials, templates, choices
    "materials coper": "did you mean copper",
    "run controller.json --target 38 --twin plant.json --object 43 --material aluminim --out r": "aluminium",
    "classify model grasps.csv --materials copper,Wood --out p.csv": "did you mean 'wood'?",
    "virtual --material wod --object 40": "wood",
    "classify model grasps.csv --materials coper,wood --out p.csv": "did you mean 'copper'?",
    "init spce": "did you mean 'spec'?",
    "init exmples": "did you mean 'examples'?",
    "excite --kind prsb --minutes 5 --out s.csv": "did you mean 'prbs'?",
    "compare grasps.csv --by sesion --out c": "did you mean 'session'?",
    "train grasps.csv --classifier bayes --split trian --out m": "did you mean 'train'?",
    "virtual --protocol tclb": "did you mean 'tclab'?",
    "record schedule.csv --port COM3 --protocol termogrip --out r": "did you mean 'thermogrip'?",
    "virtual --fault 60:sensor_opn": "did you mean 'sensor_open'?",
    # columns, signals, keys
    "identify log.csv --inputs drvie": "did you mean 'drive'?",
    "identify log.csv@10:200 --outputs t_surfce": "did you mean 't_surface'?",
    "identify long.csv.xz --disturbances t_ambeint": "did you mean 't_ambient'?",
    "linearise plant.json --at drvie=0.3": "did you mean 'drive'?",
    "run controller.json --target t_surfce=38 --twin plant.json --out r": "did you mean 't_surface'?",
    "excite --kind optimal --minutes 5 --plant plant.json --hold pmup --out s.csv": "did you mean 'pump'?",
    "tune plant.json --spec typo.toml --out c.json": "did you mean 'band_degC'?",
    "run controller.json --target 38 --twin plant.json --guard loose.toml --out r": "did you mean 'stale_s'?",
    "validate plant.json bare.csv": "time_s,drive,pump,t_ambient,t_tank,t_surface (-: left out)",
    # files
    "validate plnt.json log.csv": "did you mean 'plant.json'?",
    "identify long.csv": "did you mean 'long.csv.xz'?",
    "validate plant.json log.csv.xz": "did you mean 'log.csv'?",
    "identify lgo.csv@10:200": "did you mean 'log.csv'?",
    "simulate plant.json dat/log.csv --out s.csv": "did you mean 'data'?",
    "classify modle grasps.csv --out p.csv": "did you mean 'model'?",
    "effusivity grasp.csv --out e.csv": "did you mean 'grasps.csv'?",
    "review controler.json": "did you mean 'controller.json'?",
    "tune plant.json --spec spce.toml --out c.json": "did you mean 'spec.toml'?",
    "run controller.json --target 38 --twin plant.json --guard gaurd.toml --out r": "mean 'guard.toml'?",
    "record schedul.csv --port COM3 --out r": "did you mean 'schedule.csv'?",
    "batch controller.json pln.csv --twin plant.json --out b": "did you mean 'plan.csv'?",
    "recover rum": "did you mean 'run'?",
    "linearise plnat.json": "did you mean 'plant.json'?",
    "validate plant.json log.cvs": "did you mean 'log.csv'?",
    "identify log.csv@10-200": "a part of a log is log.csv@START:STOP",
    "simulate plant.json log.csv --out q.txt": "write .csv, .nc or .parquet",
    "excite --kind prbs --minutes 5 --out q.txt": "write .csv, .nc or .parquet",
    "tune plant.json --out q.txt": "name it q.json",
    "classify model grasps.csv --out q.txt": "name it q.csv",
    # another kind of file
    "identify grasps.csv": "is a file of grasps, not a log; it is for effusivity, train, classify, compare",
    "validate plant.json grasps.csv": "is a file of grasps, not a log",
    "simulate plant.json grasps.csv --out s.csv": "is a file of grasps, not a log",
    "excite --kind prbs --minutes 5 --plant grasps.csv --out s.csv": "is a file of grasps, not a plant",
    "classify model log.csv --out p.csv": "is a log, not a file of grasps; it is for identify, validate",
    "train log.csv --classifier bayes --out m": "is a log, not a file of grasps",
    "compare long.csv.xz --out c": "is a log, not a file of grasps",
    "effusivity grasps_meta.csv --out e.csv": "read with them",
    "validate log.csv plant.json": "is a log, not a plant; write validate PLANT LOG...",
    "classify grasps.csv model --out p.csv": "write classify MODEL_DIR GRASPS...",
    "batch plan.csv controller.json --twin plant.json --out b": "write batch CONTROLLER PLAN.csv",
    "validate controller.json log.csv": "not a plant; it is for review, export, run, batch",
    "tune controller.json --out c.json": "is a controller, not a plant",
    "review plant.json": "is a plant, not a controller; it is for validate, simulate, linearise",
    "run plant.json --target 38 --twin plant.json --out r": "write run CONTROLLER --twin PLANT",
    "identify plant.json": "is a plant, not a log",
    "identify run": "give run/samples.csv",
    "identify model": "is a trained classifier, not a log; it is for",
    "classify run grasps.csv --out p.csv": "not a trained classifier; it is for recover",
    "recover run/samples.csv": "give run",
    "recover log.csv": "is a log, not the folder of a run",
    "tune plant.json --spec guard.toml --out c.json": "is a guard's settings, not a spec of tune",
    "identify log.csv --network spec.toml": "is a spec of tune, not a thermal network; it is for tune",
    "identify net.toml": "write identify LOG... --network NAME|FILE",
    # what is missing, and values
    "run controller.json --target 38 --out r": "give --port DEV, or --twin PLANT",
    "batch controller.json plan.csv --out b": "give --port DEV, or --twin PLANT",
    "run controller.json --target 38C --twin plant.json --out r": "write 38 [degC]",
    "identify log.csv --inputs drive pump": "joined by commas: --inputs drive,pump",
    "identify log.csv --average 10s": "write --average 10;",
    "excite --kind prbs --minutes 0 --out s.csv": "greater than or equal to 0.1",
    "validate log.csv": "for example thermogrip validate plant.json log.csv@1350:",
    "train grasps.csv --out m": "for example thermogrip train grasps.csv --classifier posterior --out model",
    "excite prbs --minutes 5 --out s.csv": "for example thermogrip excite --kind prbs",
    "classify grasps.csv --out p.csv": "write classify MODEL_DIR GRASPS...",
    "effusivity grasps.csv --calibrate log.csv --out e.csv": "is a log, not a file of grasps",
    "compare grasps.csv --test grasps.csv --out c": "give others to --test, or leave it out",
    "record schedule.csv --port ttyACM9 --out r": "check name, cable and power",
}  # fmt: skip


def mistaken_folder(path: Path) -> None:
    """Write the files that the mistakes are about."""
    from thermogrip.cli.main import main
    from thermogrip.mpc import design_controller

    log = "\n".join([HEADER, *small_log_rows()]) + "\n"
    (path / "log.csv").write_text(log)
    (path / "long.csv.xz").write_bytes(lzma.compress(log.encode()))
    small_plant().save(path / "plant.json")
    design_controller(small_plant()).save(path / "controller.json")
    for name, text in zip(("grasps.csv", "grasps_meta.csv"), small_grasps()):
        (path / name).write_text(text)
    for folder, name, text in (
        ("model", "classifier.json", '{"schema": "thermogrip.classifier", "classes": ["copper", "wood"]}'),
        ("run", "samples.csv", log),
        ("data", "log.csv", log),
        (".", "bare.csv", log.partition("\n")[2]),
        (".", "plan.csv", PLAN),
        (".", "own.py", OWN),
        (".", "schedule.csv", "time_s,drive,pump\n0,0,1\n1,0.5,1\n"),
        (".", "typo.toml", "settle_within_s = 300\nband_dgeC = 0.2\n"),
        (".", "loose.toml", "stale_ss = 3\n[sensors]\nslack_K = 0.4\n"),
    ):
        (path / folder).mkdir(exist_ok=True)
        (path / folder / name).write_text(text)
    for name in ("spec", "guard"):
        assert main(["init", name, "--out", str(path / f"{name}.toml")]) == 0
    assert main(["init", "network", "--out", str(path / "net.toml")]) == 0
