"""A check of a descriptor: mlcroissant's validation, and what a dataset must state besides.

mlcroissant does not know which RAI properties there are, nor that a question is no answer. Anybody
can write a descriptor: nothing is fetched, and no data file is read; for those there is
``stereogenbench verify``.
"""

import json
import re
import warnings
from collections.abc import Iterator
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import Final

from stereogenbench_data.bridges.croissant.descriptor import SEEN_AFTER_ALL, Node
from stereogenbench_data.bridges.dataset_facts import blanks
from stereogenbench_data.errors import DescriptorError, needs_extra

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


def check_descriptor(path: Path) -> list[str]:
    """Return the problems of a descriptor, one line each.

    Args:
        path: The descriptor.

    Raises:
        ExtraError: If ``mlcroissant`` is not installed.
        DescriptorError: If the file cannot be read or is not a JSON object.
    """
    try:
        node = json.loads(path.read_bytes())
        text = json.dumps(node)
    except (OSError, RecursionError, ValueError) as error:
        raise DescriptorError(
            f"{path}: cannot be read as JSON ({error}). Name a descriptor, such as croissant.json."
        ) from error
    if not isinstance(node, dict):
        raise DescriptorError(
            f"{path}: must be a JSON object, found a {type(node).__name__}. Name a descriptor."
        )
    is_own = isinstance(node.get("@context"), dict)
    if not is_own or text.count('"@context"') > 1 or '"@import"' in text:
        return [
            "@context: is missing, stands elsewhere or imports another one, which mlcroissant "
            "would fetch: write it out. Nothing else was checked"
        ]
    return [*_validated(path), *_missing_properties(node), *_contradicted_maps(node)]


def _validated(path: Path) -> list[str]:
    """Return the errors and warnings of mlcroissant."""
    with needs_extra("checking a descriptor", "croissant"):
        import mlcroissant
        from absl import logging as absl_logging
    # It states some warnings in its log alone.
    logger, heard = absl_logging.get_absl_logger(), BufferingHandler(10_000)
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
    texts += [record.getMessage() for record in heard.buffer]
    lines = [line.strip(" -") for text in texts for line in text.splitlines()]
    return [*dict.fromkeys(line for line in lines if line and not _HEADING.match(line))]


def _contradicted_maps(node: Node) -> Iterator[str]:
    """Yield the maps that train has, though scenes of the subset of unseen maps have them."""
    sets = node.get("recordSet")
    for each in sets if isinstance(sets, list) else ():
        rows = each.get("data") if isinstance(each, dict) else None
        for row in rows if isinstance(rows, list) else ():
            if isinstance(row, dict) and row.get("maps/meaning") == SEEN_AFTER_ALL:
                yield f"maps: {row.get('maps/name')!r:.100} is {SEEN_AFTER_ALL}"


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
