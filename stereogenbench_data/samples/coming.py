"""The bytes of coming samples: planned in the order in which they will be read, fetched ahead.

A `ReadCursor` for each open video follows what the decoder will do, so that each byte is fetched
once as long as its video stays open. Where the order turns out to be another one, planning starts
anew. Only data behind a URL are planned.
"""

from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from typing import Final, NamedTuple, Protocol, Self

from stereogenbench_data.media.seek_table import ReadCursor
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.selection.plan import Address, Step
from stereogenbench_data.sources.fetch_ahead import FetchAhead, Wanted
from stereogenbench_data.sources.members import MemberSource

SCENES_AHEAD: Final = 8
MOST_SCENES_AHEAD: Final = 48
"""How many unopened scenes behind a URL are planned ahead of the one that is read, and how many are
described ahead of these: at first, and at most, as each scene that was begun allows one more. Those
that an order interleaves begin together, and end together, too."""

STEPS_AHEAD: Final = 2048
"""How many steps are looked ahead for such scenes."""


_AT_ONCE: Final = 32
"""So many samples are planned at most before the next one is read."""

_SOON: Final = 16
"""What this many samples after this one need is fetched at once."""

_REFILLED_AT: Final = 0.5
"""The share of the limit below which more is planned: many samples together need fewer requests."""

_FIRST_BYTES: Final = 32_000_000
"""So many bytes are requested at first, and two more for each that was read: the first batch does
not wait for what is needed much later."""


class NeededFiles(NamedTuple):
    """What a sample is read from.

    Attributes:
        scene: Its scene.
        frames: Name of each video to the frames of it, in their order.
        texts: Names of files that are read whole, once a scene.
    """

    scene: Scene
    frames: dict[str, list[int]]
    texts: tuple[str, ...]


class OpenVideos(Protocol):
    """How many videos stay open, and how many frames of each are kept."""

    limit: int
    kept_frames: int


class _Planned(NamedTuple):
    """A planned sample, by its number, and the bytes planned for the order up to it."""

    number: int
    address: Address
    up_to_bytes: int


class ComingSamples:
    """Plans the bytes of coming samples, and of the one that is read now."""

    def __init__(self, source: MemberSource, ahead: FetchAhead, streams: OpenVideos) -> None:
        """Plan nothing yet.

        Args:
            source: Where the files are.
            ahead: What fetches them.
            streams: Says how many videos stay open, and how many frames of each are kept.
        """
        self._source = source
        self._ahead = ahead
        self._streams = streams
        self._due: deque[_Planned] = deque()
        self._waiting: deque[_Planned] = deque()  # for their requests
        self._number = self._begun = 0
        self._positions: OrderedDict[tuple[str, int, int], ReadCursor | None] = OrderedDict()
        self._read_texts: set[str] = set()
        self._begin_anew()

    def _begin_anew(self) -> None:
        for planned in self._due:
            self._ahead.release(planned.number)
        self._due.clear()
        self._waiting.clear()
        self._planned_bytes = self._read_bytes = 0
        self._steps: Iterator[Step] = iter(())
        self._positions.clear()
        self._read_texts.clear()
        self._is_filling = True

    def expect(self, steps: Iterable[Step]) -> None:
        """Take the samples that will be read next; they replace those expected before."""
        if self._due:
            self._begin_anew()
        self._steps = iter(steps)

    def is_next(self, address: Address, files: Callable[[Address], NeededFiles]) -> bool:
        """Return whether a sample is the one that is expected next.

        Args:
            address: The sample.
            files: As for `begin`.
        """
        if not self._due:
            self._plan_next(files)
        return bool(self._due) and self._due[0].address == address

    def begin(self, address: Address, files: Callable[[Address], NeededFiles]) -> None:
        """Plan a sample that is read now, unless it is planned, and some of those after it.

        Args:
            address: The sample.
            files: Returns what a sample is read from; not kept, as it refers to who keeps this.
        """
        if not self.is_next(address, files):
            if self._due:
                self._begin_anew()
            self._plan(Step(address, ends_run=False), files(address))
        first = self._due[0].number
        self._begun = max(self._begun, first)
        self._ahead.begin(self._begun)
        if not self._is_filling:
            low = _REFILLED_AT * self._ahead.limit_bytes
            self._is_filling = self._ahead.planned_bytes < low
        for _ in range(_AT_ONCE if self._is_filling else 0):
            self._is_filling = self._ahead.planned_bytes < self._ahead.limit_bytes
            self._is_filling = self._is_filling and self._plan_next(files)
            if not self._is_filling:
                break
        # While more is planned, requests for later samples wait: they may grow.
        last = first + _SOON if self._is_filling else self._number
        up_to_bytes = _FIRST_BYTES + 2 * self._read_bytes
        while self._waiting and (
            self._waiting[0].number <= first
            or (self._waiting[0].number <= last and self._waiting[0].up_to_bytes <= up_to_bytes)
        ):
            self._begun = self._waiting.popleft().number
        self._ahead.begin(self._begun)

    def end(self, address: Address) -> None:
        """Forget what a sample that was read needed alone."""
        if self._due and self._due[0].address == address:
            read = self._due.popleft()
            self._read_bytes = read.up_to_bytes
            self._ahead.release(read.number)

    def close(self) -> None:
        """End all requests, and expect no sample."""
        self._begin_anew()
        self._ahead.close()

    def _plan_next(self, files: Callable[[Address], NeededFiles]) -> bool:
        step = next(self._steps, None)
        if step is not None:
            self._plan(step, files(step.address))
        return step is not None

    def _plan(self, step: Step, needed: NeededFiles) -> None:
        self._number += 1
        scene, wanted = needed.scene, list[Wanted]()
        for name in needed.texts:
            member = scene.members.get(name)
            if member is not None and scene.id.key not in self._read_texts:
                wanted += self._source.wanted(scene, name)
                self._read_texts.add(scene.id.key)
        for name, frames in needed.frames.items():
            if scene.held_name(name) in scene.members:
                wanted += self._of_video(scene, name, frames, run=step.address.run)
        if step.ends_run:
            for member in scene.members.values():
                self._positions.pop((member.path, member.offset, step.address.run), None)
        before_bytes = self._ahead.planned_bytes
        self._ahead.plan(self._number, wanted)
        self._planned_bytes += self._ahead.planned_bytes - before_bytes
        planned = _Planned(self._number, step.address, self._planned_bytes)
        self._due.append(planned)
        self._waiting.append(planned)

    def _of_video(self, scene: Scene, name: str, frames: list[int], *, run: int) -> list[Wanted]:
        member = scene.member(name)
        place = (member.path, member.offset, run)
        if place not in self._positions:
            while len(self._positions) >= self._streams.limit > 0:
                self._positions.popitem(last=False)
            kept = self._streams.kept_frames
            self._positions[place] = self._source.position(scene, name, kept_frames=kept)
            if self._source.is_cached:
                return self._source.wanted(scene, name)
        self._positions.move_to_end(place)
        position = self._positions[place]
        if position is None:
            return []
        ranges = sorted(each for frame in frames for each in position.needed(frame))
        return self._source.wanted(scene, name, ranges)


class DescribedAhead:
    """The steps of an order over unopened scenes behind a URL, which are opened ahead of them.

    It ends for now where too many scenes are given that were not begun: describing costs requests.
    """

    def __init__(self, steps: Iterable[Step], describe: Callable[[Address], None]) -> None:
        self._steps, self._describe = iter(steps), describe
        self._waiting: deque[Step] = deque()
        self._soon: set[int] = set()
        self._given: set[int] = set()
        self._begun: set[int] = set()

    def begin(self, row: int) -> None:
        """Take a scene as begun."""
        self._begun.add(row)
        self._given.add(row)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Step:
        most = min(SCENES_AHEAD + len(self._begun), MOST_SCENES_AHEAD)
        while len(self._soon) < most and len(self._waiting) < STEPS_AHEAD:
            step = next(self._steps, None)
            if step is None:
                break
            self._waiting.append(step)
            row = step.address.row
            if row not in self._given and row not in self._soon:
                self._soon.add(row)
                self._describe(step.address)
        if not self._waiting:
            raise StopIteration
        row = self._waiting[0].address.row
        if row not in self._given and len(self._given) - len(self._begun) >= most:
            raise StopIteration
        self._given.add(row)
        self._soon.discard(row)
        return self._waiting.popleft()
