"""Train and evaluate on StereoGenBench: stereo pairs with disparity, masks and poses.

Public names are imported when they are first used: what does not need torch starts without it.
The names and their modules are listed in `__init__.pyi`. Nothing is imported at first, not
even `typing`: the command takes care of Ctrl-C only after this module.
"""


def __getattr__(name: str) -> object:
    """Import a public name from the module that holds it."""
    if name == "__version__":
        from importlib.metadata import version

        return version("stereogenbench-data")
    if name.startswith("_") and name != "__all__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    modules = _modules()
    if name == "__all__":
        return sorted(modules)
    if name not in modules:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import gc
    from importlib import import_module

    # What is imported stays: collecting garbage on the way would only search all of torch.
    was_on = gc.isenabled()
    gc.disable()
    try:
        found = globals()[name] = getattr(import_module(modules[name]), name)
    finally:
        if was_on:
            gc.enable()
    return found


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*_modules(), "__version__"])


def _modules() -> dict[str, str]:
    """Return the module of each public name, as the stub beside this file imports it."""
    from ast import ImportFrom, parse
    from pathlib import Path

    stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    imports = [node for node in parse(stub).body if isinstance(node, ImportFrom)]
    return {each.names[0].name: str(each.module) for each in imports}
