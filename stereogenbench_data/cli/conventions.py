"""``stereogenbench conventions``: how a dataset's files are read, learned once or tested."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereogenbench_data.cli.errors import FINDINGS
from stereogenbench_data.cli.options import (
    OutOption,
    RootArgument,
    SceneOptions,
    WorkOptions,
    grouped,
    option,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import write_report
from stereogenbench_data.schema.text import counted, plain_line

if TYPE_CHECKING:
    from stereogenbench_data.audit.survey import Survey


@grouped
def conventions(  # noqa: PLR0913 - one parameter an option
    root: RootArgument,
    *,
    out: OutOption = None,
    check: Annotated[
        Path | None, option("--check", "Test these conventions; learn none.", metavar="FILE")
    ] = None,
    scenes: Annotated[int, option("Scenes to read.", min=1)] = 20,
    pictures: Annotated[
        int, option("Scenes of a shape to compare with their pictures.", min=0)
    ] = 6,
    chosen: SceneOptions,
    work: WorkOptions,
) -> None:
    """Learn how a dataset's files are read, and write it down.

    Reads some scenes, spread over families, maps and keys of files, and says where each quantity
    stands, how it is read and how that is known; the doctor measures the depth of some by their
    pictures. What is not settled has candidates as comments, best first.
    Without -o the file is printed. Give it to any command with --conventions. The last line says
    what is settled and what to do next; the exit status is 1 if something is not settled.

    Example: `stereogenbench conventions scenes/ -o conventions.toml`
    """
    from stereogenbench_data.audit.survey import survey
    from stereogenbench_data.schema.conventions import Conventions

    if check is not None and out is not None:
        reason = "--check tests a file and writes none: leave it out."
        raise typer.BadParameter(reason, param_hint="--out")
    stated = None if check is None else Conventions.read(check)
    with progress_bar("reading scenes", unit="scenes") as progress:
        found = survey(
            root,
            scenes=scenes,
            pictured=pictures,
            conventions=stated,
            wanted=chosen.by_path(),
            **work.options(),
            progress=progress,
        )
    if check is None and out is None:
        typer.echo(found.toml, nl=False)
    usable = sum(each.scene is not None for each in found.examined)
    typer.echo(f"{counted(usable, 'scene')} of {len(found.examined)} read", err=True)
    told = [f"depth: {line}" for line in found.verdicts] + found.poses
    told += [f"NOT SETTLED: {line}" for line in found.unsettled]
    if out is not None:
        write_report(out, found.toml)
        told.append(f"{out}: written")
    typer.echo("".join(f"{plain_line(line)}\n" for line in told), err=True, nl=False)
    typer.echo(
        _last_line(found, root=root, file=check or out, is_check=check is not None), err=True
    )
    if found.problems:
        raise typer.Exit(FINDINGS)


def _last_line(found: "Survey", *, root: str, file: Path | None, is_check: bool) -> str:
    """Return what is settled, what is not, and the next command."""
    untested = f"; no picture could test {', '.join(found.untested)}" if found.untested else ""
    if is_check:
        told = f"{file}: {'contradicted' if found.problems else 'fits'}{untested}"
    else:
        by_state = [", ".join(name for name, is_settled in found.settled.items()
                              if is_settled == wanted) for wanted in (True, False)]  # fmt: skip
        told = f"settled: {by_state[0] or 'nothing'}; not settled: {by_state[1] or 'nothing'}"
        told = told if by_state[1] or not found.problems else f"{told} but what is told above"
    name = file or "conventions.toml"
    if found.problems:
        edit = "correct" if is_check else "uncomment a candidate in" if found.candidates else "edit"
        return f"{told}. Next: {edit} {name}, then stereogenbench conventions {root} --check {name}"
    return f"{told}. Next: stereogenbench show {root} --conventions {name} -o first.png"
