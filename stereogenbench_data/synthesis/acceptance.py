"""The report on proposals: how many were accepted, and why the others were refused."""

from collections import Counter, defaultdict
from collections.abc import Iterable

from stereogenbench_data.schema.text import markdown_table
from stereogenbench_data.synthesis.filters import Refusal
from stereogenbench_data.synthesis.planning import Planned

ALL_MAPS = "all maps"


def acceptance_markdown(planned: Iterable[Planned]) -> str:
    """Return what became of proposals as a table in Markdown, by map and over all maps."""
    groups: dict[str, list[Refusal | None]] = defaultdict(list)
    for scene in planned:
        for proposal, refusal in (*scene.refused, (scene.plan.proposal, None)):
            for name in (ALL_MAPS, proposal.map_name):
                groups[name].append(refusal)
    rows = [("map", "proposals", "accepted", "refused for")]
    for name in sorted(groups, key=lambda each: (each == ALL_MAPS, each)):
        found = groups[name]
        reasons = Counter(refusal.reason for refusal in found if refusal)
        accepted = len(found) - reasons.total()
        rows.append(
            (
                name,
                f"{len(found):,}",
                f"{accepted:,} ({accepted / len(found):.1%})",
                ", ".join(f"{reason} {count:,}" for reason, count in reasons.most_common()),
            )
        )
    return "".join(f"{line}\n" for line in markdown_table(*rows))
