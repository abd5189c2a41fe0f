"""What the numbers of a depth file mean in metres, as the file, its scene or the user states it."""

from collections.abc import Sequence
from dataclasses import replace

from stereogenbench_data.errors import MediaError, SchemaError
from stereogenbench_data.media.container import StreamFacts
from stereogenbench_data.media.depth import DEPTH_CURES, largest_number
from stereogenbench_data.schema.depth_contract import Statement, agreed, stated_in_tags
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import DEFAULT_DEPTH_UNIT_M


def resolve_encoding(
    facts: StreamFacts,
    *,
    name: str,
    override: DepthEncoding | None = None,
    stated: Sequence[Statement] = (),
) -> DepthEncoding:
    """Return how a depth stream's numbers become metres: as the user says, else as files state.

    Tags of the container and the stream and the scene's JSON are read as `depth_contract` reads
    them; all must agree. Where nothing is stated the release's default holds, 0.1 m.

    Args:
        facts: What `probe` found.
        name: What messages call the file.
        override: The user's contract, which holds whatever files say if it has a unit.
        stated: What the scene's JSON says.

    Raises:
        MediaError: If what is stated is not understood, or contradicts itself.

    Source: the paper's appendix on the file schema.
    """
    if override is not None and override.unit_m is not None:
        return replace(override, source="user")
    contract = override or DepthEncoding()
    largest = largest_number(facts.pixel_format) or 2**16 - 1
    try:
        found = agreed([*stated_in_tags(facts.tags, name=name), *stated], largest=largest)
    except SchemaError as error:
        raise MediaError(f"{error}. {DEPTH_CURES}") from error
    if found.unit_m is None:
        return contract.with_file_unit(DEFAULT_DEPTH_UNIT_M, source="default")
    return contract.with_file_unit(found.unit_m, source=found.origin, offset_m=found.offset_m)
