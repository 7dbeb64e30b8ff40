"""Control: prediction model, observer, condensed QP, controller, PI baseline, tuning, review."""

from thermogrip import lazy_exports

# doors of 0.1.0, which are found and not listed
_ALSO = {
    "closed_loop.simulate": ("ClosedLoop", "Surroundings"),
    "design.design": ("Design",),
    "design.spec": ("Spec",),
}

__all__, __getattr__, __dir__ = lazy_exports(__name__, _ALSO)
