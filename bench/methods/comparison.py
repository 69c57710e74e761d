"""The methods that every model is compared with: physics and plug-ins."""

from __future__ import annotations

from bench.methods import method_plugins
from bench.methods.method_interface import Method
from bench.methods.physics import Physics
from synth.errors import UserError

# Names of the methods in tables, reports and score.json.
MAIN = "D2FNet"  # the given model
PHYSICS = "physics"
FUSION = "network and physics"


def simpler_methods() -> dict[str, Method]:
    """Physics and the plug-ins of installed packages. UserError if one has the name of a method of ours."""
    methods: dict[str, Method] = {PHYSICS: Physics()}
    plug_ins = method_plugins.list_installed()
    if reserved := {FUSION, MAIN, *methods} & set(plug_ins):
        raise UserError(f"method {min(reserved)}: this name is reserved; rename the plug-in's method")
    return methods | plug_ins
