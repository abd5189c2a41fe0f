"""What `help` says of calls: each option with its type and its default, declared once."""

import ast
import inspect
import pydoc
from pathlib import Path

import pytest

import stereogenbench_data
from stereogenbench_data import SceneViews, StereoPairs, StereoPairStream
from stereogenbench_data.selection.signatures import Told

PACKAGE = Path(stereogenbench_data.__file__).parent


def options_of(call):
    """The options of a call that have a default which depends on nothing."""
    return {
        name: each.default
        for name, each in inspect.signature(call).parameters.items()
        if each.kind is each.KEYWORD_ONLY and not isinstance(each.default, Told)
    }


def help_on(thing):
    return pydoc.render_doc(thing, renderer=pydoc.plaintext)


def test_help_lists_the_options_of_a_dataset_and_of_its_loader(small_shards):
    pairs = StereoPairs(small_shards)

    of_pairs, of_loader = help_on(StereoPairs), help_on(pairs.loader)

    assert "    size: tuple[int, int] | str | None = None,\n" in of_pairs
    assert "    family: str | Sequence[str] | None = None,\n" in of_pairs
    assert "    check: Literal['read', 'opened', 'metadata'] = 'read',\n" in of_pairs
    assert "    shuffle: bool = True,\n" in of_loader
    assert "    rank: int = <torch.distributed's, or 0>,\n" in of_loader
    assert "    persistent_workers: bool = False,\n" in of_loader
    assert ") -> PairsLoader" in of_loader


@pytest.mark.parametrize("kind", [StereoPairs, SceneViews])
def test_the_defaults_that_help_lists_are_those_that_hold(small_shards, kind):
    plain, stated = kind(small_shards), kind(small_shards, **options_of(kind))

    assert plain.plan.digest == stated.plan.digest
    assert plain.request == stated.request
    assert repr(plain) == repr(stated)
    assert plain.buffers == stated.buffers


def test_the_defaults_of_a_loader_that_help_lists_are_those_that_hold(small_shards):
    pairs = StereoPairs(small_shards, pairs="all")

    plain, stated = pairs.loader(2), pairs.loader(2, **options_of(pairs.loader))

    assert plain.batches.rule == stated.batches.rule
    assert plain.state_dict() == stated.state_dict()
    names = ("pin_memory", "timeout", "prefetch_factor", "persistent_workers")
    assert [getattr(plain, name) for name in names] == [getattr(stated, name) for name in names]


def test_a_stream_lists_its_own_options_beside_those_of_pairs_and_epochs():
    listed = inspect.signature(StereoPairStream).parameters

    assert {"fields", "size", "family", "shuffle_groups", "seed"} <= listed.keys()
    assert "options" not in listed


def test_every_function_that_unpacks_options_lists_them():
    unlisted = [
        f"{path.relative_to(PACKAGE)}: {node.name}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and node.args.kwarg is not None
        if "Unpack[" in ast.unparse(node.args.kwarg)
        if not any("list_options(" in ast.unparse(each) for each in node.decorator_list)
    ]

    assert unlisted == []
