"""A trial of reading: damaged copies of scenes, and whether reading names the damage.

    python -m tests.datasets.damage_trial --copies 420 --seed 7

draws two scenes, keeps them as a folder, a folder with an index, shards and training shards,
damages one file of a copy at a time, and reads frames of all pairs of neighbouring cameras as a
training would. Each outcome is "named" (an error of the package), "right" (all samples equal those
of the undamaged data) or "WRONG" (a sample differs, in silence).
"""

import argparse
import shutil
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import typer
from typer.testing import CliRunner

from stereogenbench_data import StereoPairs
from stereogenbench_data.cli.commands import app
from stereogenbench_data.errors import StereoGenBenchError

FIELDS = ("left", "right", "disparity", "valid")
SIZE_PX, FRAMES = 128, 15
FORMS = ("folder", "folder and index", "shards", "small", "balanced", "high")
Damage = Callable[[Path, np.random.Generator], None]


def bit_flipped(file: Path, rng: np.random.Generator) -> None:
    """Flip one bit."""
    content = bytearray(file.read_bytes())
    content[rng.integers(len(content))] ^= 1 << rng.integers(8)
    file.write_bytes(content)


def bytes_replaced(file: Path, rng: np.random.Generator) -> None:
    """Write 16 random bytes over others."""
    content = bytearray(file.read_bytes())
    place = rng.integers(max(1, len(content) - 16))
    content[place : place + 16] = rng.bytes(min(16, len(content)))
    file.write_bytes(content)


def zeroed(file: Path, rng: np.random.Generator) -> None:
    """Write a block of zeros, as a disk that lost a sector leaves it."""
    content = bytearray(file.read_bytes())
    place = rng.integers(len(content)) // 512 * 512
    content[place : place + 512] = bytes(len(content[place : place + 512]))
    file.write_bytes(content)


def cut_short(file: Path, rng: np.random.Generator) -> None:
    """Cut the end off."""
    content = file.read_bytes()
    file.write_bytes(content[: rng.integers(len(content))])


def exchanged(file: Path, rng: np.random.Generator) -> None:
    """Exchange it with a file of the same kind, of another camera or another scene."""
    others = [
        each
        for each in _root(file).rglob(f"*{file.suffix}")
        if each != file and each.stem[-5:] == file.stem[-5:]
    ]
    if not others:
        bit_flipped(file, rng)
        return
    other = others[rng.integers(len(others))]
    mine, theirs = file.read_bytes(), other.read_bytes()
    file.write_bytes(theirs)
    other.write_bytes(mine)


def _root(file: Path) -> Path:
    return next(each for each in file.parents if each.name == "copy")


DAMAGES: dict[str, Damage] = {
    "bit flipped": bit_flipped,
    "16 bytes replaced": bytes_replaced,
    "512 bytes zeroed": zeroed,
    "cut short": cut_short,
    "files exchanged": exchanged,
}


def made_forms(folder: Path, *, seed: int) -> dict[str, Path]:
    """Draw two scenes, and keep them in every form."""
    released = folder / "folder"
    _run("synth", released, "--scenes", 2, "--size", SIZE_PX, "--frames", FRAMES, "--seed", seed)
    indexed = folder / "folder and index"
    shutil.copytree(released, indexed)
    _run("index", indexed)
    _run("pack", indexed, folder / "shards")
    for quality in ("small", "balanced", "high"):
        _run("pack", indexed, folder / quality, "--size", "96x96", "--quality", quality)
    return {form: folder / form for form in FORMS}


def _run(*words: object) -> None:
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exit_code:
        raise SystemExit(f"{words}: {result.output}")


def read(data: Path, *, frames: Any) -> list[dict[str, Any]]:
    """Return samples as a training reads them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pairs = StereoPairs(data, pairs="adjacent", frames=frames, fields=FIELDS, seed=3)
        return [{name: sample[name] for name in FIELDS} for sample in pairs]


def outcome_of(data: Path, truth: list[dict[str, Any]], *, frames: Any) -> tuple[str, str]:
    """Return what reading damaged data led to, and the error's message."""
    try:
        found = read(data, frames=frames)
    except StereoGenBenchError as error:
        return "named", f"{type(error).__name__}: {error}"
    except Exception as error:  # noqa: BLE001 - an error without a name is what the trial counts
        return "NOT NAMED", f"{type(error).__name__}: {error}"
    same = len(found) == len(truth) and all(
        torch.equal(one[name], other[name])
        for one, other in zip(found, truth, strict=True)
        for name in FIELDS
    )
    return ("right" if same else "WRONG"), ""


def trials(folder: Path, *, copies: int, seed: int) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield form, kind of file, damage, outcome and message of each damaged copy."""
    forms = made_forms(folder, seed=seed)
    # The first frames of a scene, and single frames: those are not compared with whole checksums.
    ways = {"all": "all", "single": ("random", 1)}
    truths = {
        (form, way): read(data, frames=frames)
        for form, data in forms.items()
        for way, frames in ways.items()
    }
    rng = np.random.default_rng(seed)
    for _ in range(copies):
        form = str(rng.choice(FORMS))
        way = str(rng.choice(list(ways)))
        copy = folder / "copy"
        shutil.copytree(forms[form], copy)
        suffixes = (".mp4", ".mkv", ".json") if form.startswith("folder") else (".tar",)
        suffix = suffixes[
            rng.choice(len(suffixes), p=(0.55, 0.3, 0.15) if len(suffixes) > 1 else None)
        ]
        files = sorted(copy.rglob(f"*{suffix}"))
        file = files[rng.integers(len(files))]
        damage = str(rng.choice(list(DAMAGES)))
        DAMAGES[damage](file, rng)
        result, message = outcome_of(copy, truths[form, way], frames=ways[way])
        yield form, f"{way} {suffix}", damage, result, message.replace(str(copy), "")
        if result in ("WRONG", "NOT NAMED"):
            kept = folder / f"kept_{len(list(folder.glob('kept_*')))}"
            shutil.move(copy, kept)
        else:
            shutil.rmtree(copy)


def main() -> None:
    """Run the trial and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--copies", type=int, default=420)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    with TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        counts: Counter[tuple[str, str]] = Counter()
        for form, kind, damage, result, message in trials(
            folder, copies=options.copies, seed=options.seed
        ):
            counts[form, result] += 1
            if result not in ("named", "right"):
                typer.echo(" | ".join((form, kind, damage, result, message)))
    for form in FORMS:
        found = {result: n for (each, result), n in sorted(counts.items()) if each == form}
        typer.echo(f"{form}: {found}")


if __name__ == "__main__":
    main()
