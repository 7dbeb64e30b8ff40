"""Saved models: which class reads one back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.sysid.models.model import Model

_KINDS = ("network", "statespace", "neural", "sindy", "own")  # a file can name no other code


def load_model(content: Mapping[str, Any], *, code: Model | None = None) -> Model:
    """Return the model that ``Model.to_dict`` wrote, by its ``kind``; ``code`` is the class of a user's own
    model, which is in no file."""
    kind = content.get("kind") if isinstance(content, Mapping) else None
    if kind not in _KINDS:
        raise UserError(f"model of kind {kind!r} is unknown", hint=known_names(kind, _KINDS))
    if code is None:
        return _from_dict(kind, content)
    restored = getattr(code, "restored", None)
    if restored is None or kind != code.kind:
        raise UserError(f"its model ({kind}) needs no class", hint="leave the class out")
    own: Model = restored(content)
    return own


def _from_dict(kind: str, content: Mapping[str, Any]) -> Model:
    """Return a model of a known kind, whose class alone is imported: of some that takes a while."""
    if kind == "network":
        from thermogrip.sysid.models.network import NetworkModel

        return NetworkModel.from_dict(content)
    if kind == "statespace":
        from thermogrip.sysid.models.state_space import StateSpaceModel

        return StateSpaceModel.from_dict(content)
    if kind == "neural":
        from thermogrip.sysid.models.neural import NeuralModel

        return NeuralModel.from_dict(content)
    if kind == "sindy":
        from thermogrip.sysid.models.polynomial import SindyModel

        return SindyModel.from_dict(content)
    from thermogrip.sysid.models.user_model import OwnModel

    return OwnModel.from_dict(content)  # which refuses: its code is not in the file
