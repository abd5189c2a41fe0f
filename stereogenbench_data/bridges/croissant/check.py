"""A check of a descriptor: mlcroissant's validation, and what that does not look at.

mlcroissant opens no data file and does not know which RAI properties there are. So this check adds
those that a dataset must state, the context without which no record loads, and the files that the
descriptor names by relative paths: they must exist with the size and checksum that it states.

Anybody can write a descriptor. Nothing is fetched, and only tables and shards beside it are read.
"""

import hashlib
import json
import logging
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.bridges.croissant.descriptor import Node, template
from stereogenbench_data.bridges.dataset_facts import blanks, listed
from stereogenbench_data.errors import DescriptorError, missing_extra

REQUIRED: Final = (
    "name", "description", "url", "creator", "keywords", "distribution", "recordSet",
    "rai:dataLimitations", "rai:dataBiases", "rai:personalSensitiveInformation",
    "rai:dataUseCases", "rai:dataSocialImpact", "rai:hasSyntheticData", "prov:wasDerivedFrom",
    "prov:wasGeneratedBy",
)  # fmt: skip
"""Properties that a dataset must state and mlcroissant does not ask for."""
RAI_NAMES: Final = frozenset(
    {
        "dataCollection", "dataCollectionMissingData", "dataCollectionRawData",
        "dataCollectionTimeframe", "dataCollectionType", "dataImputationProtocol",
        "dataManipulationProtocol", "dataPreprocessingProtocol", "dataAnnotationProtocol",
        "dataAnnotationPlatform", "dataAnnotationAnalysis", "annotationsPerItem",
        "annotatorDemographics", "machineAnnotationTools", "dataBiases", "dataUseCases",
        "dataLimitations", "dataSocialImpact", "personalSensitiveInformation",
        "dataReleaseMaintenancePlan", "hasSyntheticData",
    }
)  # fmt: skip
"""The properties of the RAI 1.0 specification, and hasSyntheticData."""
_HEADING: Final = re.compile(r"Found the following \d+ (error|warning)")
_DATA_SUFFIXES: Final = (".tar", ".parquet", ".txt")
_NO_PATH: Final = re.compile(r"^[/~]|\\|:|[\x00-\x1f]")


def check_descriptor(path: Path) -> list[str]:
    """Return the problems of a descriptor, one line each.

    Args:
        path: The descriptor.

    Raises:
        ExtraError: If ``mlcroissant`` is not installed.
        DescriptorError: If the file cannot be read or is not a JSON object.
    """
    node, has_other_contexts = _read(path)
    if has_other_contexts:
        return [
            "@context: stands in a part of the descriptor or imports another one, which "
            "mlcroissant would fetch: remove it. Nothing else was checked"
        ]
    problems = _validated(path)
    try:
        problems += [*_missing_properties(node), *_wrong_terms(node)]
        problems += _wrong_files(node, path.parent)
    except (AttributeError, OSError, RecursionError, TypeError) as error:
        problems.append(f"{path.name}: does not have the structure of a descriptor ({error})")
    return problems


def _read(path: Path) -> tuple[Node, bool]:
    """Return a descriptor, and whether it has more contexts than its own."""
    try:
        node = json.loads(path.read_bytes())
        text = json.dumps(node)
    except RecursionError as error:
        raise DescriptorError(
            f"{path}: lists or objects are nested hundreds of levels deep. Name a descriptor, such "
            f"as croissant.json."
        ) from error
    except (OSError, ValueError) as error:
        raise DescriptorError(
            f"{path}: cannot be read as JSON ({error}). Name a descriptor, such as croissant.json."
        ) from error
    if not isinstance(node, dict):
        raise DescriptorError(
            f"{path}: must be a JSON object, found a {type(node).__name__}. Name a descriptor."
        )
    return node, text.count('"@context"') > 1 or '"@import"' in text


class _Warnings(logging.Handler):
    """Keeps what mlcroissant logs: it states some warnings nowhere else."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a message."""
        self.texts.append(record.getMessage())


def _validated(path: Path) -> list[str]:
    """Return the errors and warnings of mlcroissant."""
    try:
        import mlcroissant
        from absl import logging as absl_logging
    except ImportError as error:
        raise missing_extra("checking a descriptor", "croissant", error) from error
    logger, heard = absl_logging.get_absl_logger(), _Warnings()
    handlers, logger.handlers = logger.handlers, [heard]
    propagates, logger.propagate = logger.propagate, False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what its own dependencies will change
            found = mlcroissant.Dataset(jsonld=str(path)).metadata.issues
        texts = [*found.warnings, *found.errors]
    except mlcroissant.ValidationError as error:
        texts = [str(error)]
    except (AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        texts = [f"{path.name}: mlcroissant cannot read it ({type(error).__name__}: {error})"]
    finally:
        logger.handlers, logger.propagate = handlers, propagates
    lines = [line.strip(" -") for text in [*texts, *heard.texts] for line in text.splitlines()]
    return [*dict.fromkeys(line for line in lines if line and not _HEADING.match(line))]


def _missing_properties(node: Node) -> Iterator[str]:
    for name in REQUIRED:
        if node.get(name) in (None, "", [], {}):
            yield f"{name}: is missing or empty"
    for name in node:
        prefix, _, local = name.partition(":")
        if prefix == "rai" and local not in RAI_NAMES:
            yield f"{name}: is not a property of RAI 1.0: check its spelling"
    for place in blanks(node):
        yield f"{place}: must be filled in: what stands there is the question"


def _wrong_terms(node: Node) -> Iterator[str]:
    wanted, context = template("common"), node.get("@context")
    lacking = [each for each in wanted["conformsTo"] if each not in listed(node.get("conformsTo"))]
    if lacking:
        yield f"conformsTo: lacks {', '.join(lacking)}"
    terms = wanted["@context"].items()
    found = context if isinstance(context, dict) else {}
    if differing := [term for term, meaning in terms if found.get(term) != meaning]:
        yield (
            f"@context: {', '.join(differing)}: not as in Croissant 1.1, and with the context of "
            "another version no record loads"
        )


def _wrong_files(node: Node, folder: Path) -> Iterator[str]:
    for file in listed(node.get("distribution")):
        url = str(file.get("contentUrl", "https://"))
        if "://" in url and url[:5].lower() != "file:":
            continue
        if _NO_PATH.search(url) or not url.endswith(_DATA_SUFFIXES):
            yield (
                f"{file.get('@id')}: has the contentUrl {url!r}, and a path must be relative and "
                f"end in {', '.join(_DATA_SUFFIXES)}"
            )
        else:
            yield from _differences(file, folder / url)


def _differences(file: Node, path: Path) -> Iterator[str]:
    """Say what of a local file differs from its description."""
    name: Any = file.get("@id")
    if not path.is_file():
        yield f"{name}: {path} does not exist: write the descriptor again beside its files"
        return
    size = f"{path.stat().st_size} B"
    if file.get("contentSize", size) != size:
        yield f"{name}: has {size}, and the descriptor says {file['contentSize']}"
    with path.open("rb") as opened:
        found = hashlib.file_digest(opened, "sha256").hexdigest()
    if found != file.get("sha256"):
        yield (
            f"{name}: does not have the sha256 {file.get('sha256')!r} of the descriptor: the file "
            "was replaced or damaged: fetch it again, or write the descriptor again"
        )
