"""What a worker process needs to open the files of one scene."""

from dataclasses import dataclass

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Scene, ShardFacts
from stereogenbench_data.sources.members import MemberSource
from stereogenbench_data.sources.retry import RetryPolicy


@dataclass(frozen=True, slots=True)
class SceneAccess:
    """A scene and where its files are; can be sent to worker processes.

    Attributes:
        scene: The scene.
        root: The folder or URL that members' paths are relative to.
        shards: The index's facts of the shards that hold the scene.
        revision: The index's digest.
        retry: The retry policy, None for the default.
    """

    scene: Scene
    root: str
    shards: dict[str, ShardFacts]
    revision: str
    retry: RetryPolicy | None

    @classmethod
    def of(cls, index: SceneIndex, scene: Scene) -> "SceneAccess":
        """Return the access to a scene of an index."""
        paths = {member.path for member in scene.members.values()}
        shards = {path: index.shards[path] for path in paths if path in index.shards}
        return cls(scene, index.root, shards, index.digest, index.retry)

    @property
    def key(self) -> str:
        """The scene's key."""
        return self.scene.id.key

    def source(self) -> MemberSource:
        """Return a source of the scene's files; nothing is opened yet."""
        return MemberSource(self.root, shards=self.shards, revision=self.revision, retry=self.retry)
