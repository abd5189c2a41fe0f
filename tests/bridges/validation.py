"""What mlcroissant and the RAI specification find wrong with a descriptor that was written."""

import json
import warnings
from logging.handlers import BufferingHandler

import mlcroissant
from absl import logging as absl_logging

REQUIRED = (
    "name", "description", "url", "creator", "keywords", "distribution", "recordSet",
    "rai:dataLimitations", "rai:dataBiases", "rai:personalSensitiveInformation",
    "rai:dataUseCases", "rai:dataSocialImpact", "rai:hasSyntheticData", "prov:wasDerivedFrom",
    "prov:wasGeneratedBy",
)  # fmt: skip
"""Properties that a dataset must state and mlcroissant does not ask for."""
RAI_NAMES = {
    "dataCollection", "dataCollectionMissingData", "dataCollectionRawData",
    "dataCollectionTimeframe", "dataCollectionType", "dataImputationProtocol",
    "dataManipulationProtocol", "dataPreprocessingProtocol", "dataAnnotationProtocol",
    "dataAnnotationPlatform", "dataAnnotationAnalysis", "annotationsPerItem",
    "annotatorDemographics", "machineAnnotationTools", "dataBiases", "dataUseCases",
    "dataLimitations", "dataSocialImpact", "personalSensitiveInformation",
    "dataReleaseMaintenancePlan", "hasSyntheticData",
}  # fmt: skip
"""The properties of the RAI 1.0 specification, and hasSyntheticData."""


def problems_of(path):
    """Return the errors and warnings of mlcroissant, and what is missing or misspelt of RAI."""
    node = json.loads(path.read_text())
    # It states some warnings in its log alone.
    logger, heard = absl_logging.get_absl_logger(), BufferingHandler(10_000)
    logger.addHandler(heard)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what its own dependencies will change
            found = mlcroissant.Dataset(jsonld=str(path)).metadata.issues
    finally:
        logger.removeHandler(heard)
    own = {name.removeprefix("rai:") for name in node if name.startswith("rai:")}
    return [
        *found.warnings,
        *found.errors,
        *(record.getMessage() for record in heard.buffer),
        *(f"{name}: is missing or empty" for name in REQUIRED if node.get(name) in (None, "", [])),
        *sorted(own - RAI_NAMES),
        *(["a question is not answered"] if "FILL IN:" in json.dumps(node) else []),
    ]
