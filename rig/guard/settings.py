"""What the guard allows, read from TOML: every key with its unit, its default, and the range it may have.

A file that is wrong anywhere is refused as a whole: a limit that is not understood would be a limit that is
not kept.  No file can switch a check off: each number has a range in which the check still works.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PrivateAttr, Strict, ValidationError
from pydantic import model_validator as whole

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.files import read_toml
from thermogrip.mpc.design.design import problem_of
from thermogrip.sysid.plant.plant import Plant

GUARD_TEMPLATE = (files(__package__) / "guard.toml").read_text(encoding="utf-8")

#: Beyond these the device switches off by itself (rig/firmware/config.h, virtual devices) [degC].
DEVICE_LIMITS = {"t_tank": (2.0, 60.0), "t_surface": (3.0, 55.0)}

#: The hottest limit that may be stated [degC]: above the thermocouples of a kiln (type S ends at 1768 degC).
HOTTEST = 1800.0


def _rising(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] < ends[1]:
        raise ValueError(f"{ends[0]:g} to {ends[1]:g} is empty: write the lower one first")
    return ends


Number = Annotated[float, Strict()]  # neither "2 s" nor true
Limit = Annotated[Number, Field(ge=-50, le=HOTTEST)]
Limits = Annotated[tuple[Limit, Limit], AfterValidator(_rising)]
SkinLimit = Annotated[Number, Field(ge=-50, le=150)]
Reading = Annotated[Number, Field(ge=-50, le=HOTTEST + 50)]
Window = Annotated[Number, Field(ge=2, le=600)]
Floor = Annotated[Number, Field(ge=0.05, le=20)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SensorSettings(_Table):
    """What a sensor may do."""

    # a reading outside is suspect
    believable_degC: Annotated[tuple[Reading, Reading], AfterValidator(_rising)] = (-5.0, 75.0)
    rate_K_per_s: Annotated[Number, Field(ge=0.05, le=100)] = 5.0  # fastest change of water
    slack_K: Annotated[Number, Field(ge=0, le=10)] = 0.5  # noise allowance of a change
    bad_in_a_row: Annotated[int, Strict(), Field(ge=1, le=20)] = 3  # so many suspect readings trip
    noise_K: Annotated[Number, Field(ge=0.001, le=5)] = 0.04  # least white noise, standard deviation
    # probability that a healthy sensor repeats itself until it counts as stuck
    alpha: Annotated[Number, Field(ge=1e-15, le=1e-3)] = 1e-9
    pair_limit_K: Annotated[Number, Field(ge=0.1, le=50)] = 4.0  # of ``x`` and ``x_2``
    pair_s: Annotated[Number, Field(ge=0, le=3600)] = 30.0  # for how long they may differ by more
    # share of the last minute without a good reading that trips: three in a row come every 84 readings then
    lost_share: ClassVar[float] = 0.25
    lost_s: ClassVar[float] = 60.0  # memory of that share


class ModelSettings(_Table):
    """How far the rig may be from its model (docs/reference/faults.md), and the noise of the filter."""

    windows_s: Annotated[tuple[Window, ...], Field(min_length=1, max_length=6)] = (10.0, 30.0, 90.0)
    # of each, where the model predicts no change
    floors_K: Annotated[tuple[Floor, ...], Field(min_length=1, max_length=6)] = (0.55, 0.35, 0.45)
    share: Annotated[Number, Field(ge=0, le=2)] = 0.25  # allowed part of the change in the window
    switching_K: Annotated[Number, Field(ge=0, le=20)] = 0.5  # besides, where the pump was switched in it
    smooth_s: Annotated[Number, Field(ge=0, le=60)] = 3.0  # readings of so long are averaged
    bias_limit_K: Annotated[Number, Field(ge=0.1, le=20)] = 2.0  # of an output
    # of a drive's bias, a share of what was asked for lately: three of the 5 % from run to run
    drive_limit: Annotated[Number, Field(ge=0.01, le=0.45)] = 0.15
    # nothing is compared where it starts not at rest
    warm_up_s: Annotated[Number, Field(ge=0, le=3600)] = 60.0
    # an innovation that makes a reading suspect: standard deviations, and kelvin
    jump_k: Annotated[Number, Field(ge=3, le=100)] = 8.0
    jump_floor_K: Annotated[Number, Field(ge=0.1, le=50)] = 3.0
    state_K_per_sqrt_s: Annotated[Number, Field(ge=1e-4, le=1)] = 0.01  # process noise of the states
    drive_per_sqrt_s: Annotated[Number, Field(ge=1e-5, le=0.1)] = 0.002  # of a drive's bias
    output_K_per_sqrt_s: Annotated[Number, Field(ge=1e-5, le=1)] = 0.002  # of an output's bias
    reading_K: Annotated[Number, Field(ge=0.001, le=5)] = 0.08  # least noise of a reading
    compared_every_s: ClassVar[float] = 1.0  # a tenth of the shortest window; it costs half of a look
    bias_after_s: ClassVar[float] = 60.0  # a bias is not evaluated before the filter has seen something

    @whole(mode="after")
    def _fitting(self) -> ModelSettings:
        windows, floors = self.windows_s, self.floors_K
        if len(windows) != len(floors):
            raise ValueError(
                f"{len(windows)} windows_s and {len(floors)} floors_K: write a floor for each window"
            )
        if list(windows) != sorted(set(windows)):
            raise ValueError("windows_s do not rise: write the shortest first")
        if not self.smooth_s < windows[0]:
            raise ValueError(f"smooth_s is not less than the shortest window, {windows[0]:g}: shorten it")
        return self


class RuleSettings(_Table):
    """Numbers of the rule that needs no model."""

    # a minute of full drive: what was heated may rise for half of it (of 72 experiments on the example rig
    # 30 s ended four, 60 s none)
    full_drive_s: Annotated[Number, Field(ge=1, le=3600)] = 60.0
    least_K: Annotated[Number, Field(ge=0.05, le=50)] = 1.0
    far_K: Annotated[Number, Field(ge=0.5, le=100)] = 8.0  # at half of full drive
    # where people work [degC]: an output outside was heated or cooled before the session
    usual_room: ClassVar[tuple[float, float]] = (10.0, 35.0)


class GuardSettings(_Table):
    """What the guard allows."""

    limits: dict[str, Limits] = {}  # of single sensors by name [degC]
    # of the skin's sensors, where ``limits`` does not name them
    skin_degC: Annotated[tuple[SkinLimit, SkinLimit], AfterValidator(_rising)] = (3.0, 55.0)
    # of every other one: water that neither freezes nor scalds
    others_degC: Limits = (-1.0, 70.0)
    # the device's own time to live of a drive: a longer silence of ours and it is off
    expiry_s: Annotated[Number, Field(ge=0.5, le=2)] = 2.0
    stale_s: Annotated[Number, Field(ge=0.5, le=60)] = 2.0  # longest time without a new reading
    # by how much the rig's clock may differ from ours between two readings
    clock_slack_s: Annotated[Number, Field(ge=0.1, le=60)] = 1.0
    # by how much the applied drive may differ from what was asked, a fraction of half its range
    drive_slack: Annotated[Number, Field(ge=0.005, le=0.5)] = 0.05
    # after a touch the skin is what the object made of it for so long
    forget_s: Annotated[Number, Field(ge=0, le=3600)] = 60.0
    # sensors that read the room, of those that the plant does not know; None goes by their names
    room_sensors: tuple[str, ...] | None = None
    sensors: SensorSettings = SensorSettings()
    model: ModelSettings = ModelSettings()
    no_model: RuleSettings = RuleSettings()
    # a reading is believed so far beyond the highest limit [K], as 75 is beyond the usual 70 degC
    believed_beyond: ClassVar[float] = 5.0
    beyond_logs: ClassVar[float] = 0.1  # of the logs' range: by so much a loop by SIMC overshoots a step
    # pause after which the model still knows the rig: that between trials of a batch
    known_s: ClassVar[float] = 300.0
    _file: str = PrivateAttr(default="")

    @property
    def file(self) -> str | None:
        """Where it was read from, for messages; None where no file says it."""
        return self._file or None

    @whole(mode="after")
    def _believed(self) -> GuardSettings:
        low, high = self.sensors.believable_degC
        ranges = {"skin_degC": self.skin_degC, "others_degC": self.others_degC}
        ranges |= {f"limits.{name}": ends for name, ends in self.limits.items()}
        for name, (least, most) in ranges.items():
            if not low <= least <= most <= high:
                raise ValueError(
                    f"{name}: {least:g} to {most:g} reaches beyond what is plausible, {low:g} to {high:g}: "
                    "narrow it, or widen sensors.believable_degC"
                )
        return self

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, file: str | Path | None = None) -> GuardSettings:
        """Return settings from plain values; a wrong or unknown key is a :class:`UserError` that names it."""
        try:
            settings = cls.model_validate(dict(content))
        except ValidationError as error:
            problem = problem_of(error)
            place, hint = problem.partition(": ")[0], "`thermogrip init guard` shows every key with its unit"
            tables: dict[str, type[_Table]]
            tables = {"sensors": SensorSettings, "model": ModelSettings, "no_model": RuleSettings}
            keys = [f"{table}.{key}" for table, kind in tables.items() for key in kind.model_fields]
            above = [table for table, kind in tables.items() if place in kind.model_fields]
            hint = known_names(place, [*cls.model_fields, *keys], hint)
            hint = f"write it below [{above[0]}]" if above else hint
            raise UserError(problem, file=file, hint=hint) from error
        settings._file = "" if file is None else str(file)
        return settings

    @classmethod
    def of(cls, plant: Plant | None, skin: str = "t_surface") -> GuardSettings:
        """Return what is allowed where no file says it: what the device allows; an output of a plant whose
        logs went beyond the usual limits may go there again."""
        usual = cls()
        coldest, hottest = usual.others_degC
        logged = {} if plant is None else {name: plant.valid.get(name) for name in plant.outputs}
        limits = {name: ends for name, ends in DEVICE_LIMITS.items() if name in logged and name != skin}
        limits |= {
            name: (coldest, ends[1] + usual.beyond_logs * (ends[1] - ends[0]))
            for name, ends in logged.items()
            if ends is not None and ends[1] > hottest and name not in (skin, f"{skin}_2")
        }
        return usual._with_limits(limits=limits)

    def _with_limits(self, **limits: Any) -> GuardSettings:
        """Return these with other limits, and readings believed until beyond every one."""
        changed = self.model_copy(update=limits)
        low, high = self.sensors.believable_degC
        highest = max(most for _, most in (changed.others_degC, *changed.limits.values()))
        believed = {"believable_degC": (low, max(high, highest + self.believed_beyond))}
        return changed.model_copy(update={"sensors": self.sensors.model_copy(update=believed)})

    def below(self, limit: float) -> GuardSettings:
        """Return these with no sensor above a limit [degC] that somebody states; where no file states others,
        it holds for all but the skin also where it is higher than usual."""
        if not self.file and limit > self.others_degC[1]:
            return self._with_limits(limits={}, others_degC=(self.others_degC[0], min(limit, HOTTEST)))

        def cut(ends: tuple[float, float]) -> tuple[float, float]:
            if limit <= ends[0]:
                problem = f"a limit of {limit:g} degC leaves nothing above {ends[0]:g}"
                raise UserError(problem, hint="raise it")
            return ends[0], min(ends[1], limit)

        limits = {name: cut(ends) for name, ends in self.limits.items()}
        skin, others = cut(self.skin_degC), cut(self.others_degC)
        return self.model_copy(update={"limits": limits, "skin_degC": skin, "others_degC": others})

    def check_sensors(self, have: Collection[str], rooms: Collection[str]) -> None:
        """Raise UserError where a limit names a sensor that the rig has not, or the room's."""
        guarded = [name for name in have if name not in rooms]  # the room's is no reason to stop
        for name in self.limits:
            if name not in guarded:
                hint = known_names(name, guarded, "name one of {}")
                raise UserError(f"the rig has no sensor {name!r} to guard", file=self.file, hint=hint)
        for name in self.room_sensors or ():
            if name not in rooms:
                problem = f"the rig has no sensor {name!r} that may read the room"
                raise UserError(problem, file=self.file, hint="name none that the plant has")


def read_guard(path: str | Path) -> GuardSettings:
    """Return what the guard allows, from a TOML file.

    Parameters
    ----------
    path : str or Path
        As ``thermogrip init guard`` writes it; what is left out has its default.

    Raises
    ------
    UserError
        Naming the file and the key that is wrong.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "guard.toml"
    >>> n = path.write_text("[limits]\\nt_tank = [2, 65]\\n")
    >>> read_guard(path).limits
    {'t_tank': (2.0, 65.0)}
    """
    content = read_toml(path, hint="`thermogrip init guard` writes one to edit")
    return GuardSettings.from_dict(content, file=path)
