"""Which scenes and frames are looked at, and where the files of one scene are."""

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.sources.members import MemberSource


def source_of(index: SceneIndex, scene: Scene) -> MemberSource:
    """Return a source of one scene's files, which can be sent to worker processes."""
    paths = {member.path for member in scene.members.values()}
    shards = {path: index.shards[path] for path in paths if path in index.shards}
    return MemberSource(index.root, shards=shards, revision=index.digest, retry=index.retry)


def spread(available: int, wanted: int) -> tuple[int, ...]:
    """Return this many numbers below ``available``, evenly spread from first to last; 0 means all.

    >>> spread(81, 5), spread(81, 1), spread(2, 5), spread(3, 0)
    ((0, 20, 40, 60, 80), (40,), (0, 1), (0, 1, 2))
    """
    if wanted == 0 or wanted >= available:
        return tuple(range(available))
    if wanted == 1:
        return (available // 2,)
    return tuple(round(step * (available - 1) / (wanted - 1)) for step in range(wanted))
