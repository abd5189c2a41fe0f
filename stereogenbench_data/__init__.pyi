"""The public names and the modules that hold them: the one list, for type checkers and imports."""

from stereogenbench_data.bridges.matching import to_raft_stereo as to_raft_stereo
from stereogenbench_data.bridges.matching import to_torchvision as to_torchvision
from stereogenbench_data.datasets.batch_buffers import collate as collate
from stereogenbench_data.datasets.batch_buffers import to_device as to_device
from stereogenbench_data.datasets.batches import EpochBatches as EpochBatches
from stereogenbench_data.datasets.batches import IdleWorkersWarning as IdleWorkersWarning
from stereogenbench_data.datasets.batches import OpenVideosWarning as OpenVideosWarning
from stereogenbench_data.datasets.batches import (
    RepeatedDecodingWarning as RepeatedDecodingWarning,
)
from stereogenbench_data.datasets.batches import RepeatedEpochWarning as RepeatedEpochWarning
from stereogenbench_data.datasets.batches import UnsharedRanksWarning as UnsharedRanksWarning
from stereogenbench_data.datasets.derive import DERIVE_FIELDS as DERIVE_FIELDS
from stereogenbench_data.datasets.derive import DERIVED_FIELDS as DERIVED_FIELDS
from stereogenbench_data.datasets.derive import derive as derive
from stereogenbench_data.datasets.forecast import forecast as forecast
from stereogenbench_data.datasets.loader import PairsLoader as PairsLoader
from stereogenbench_data.datasets.mapped import MixedSplitsWarning as MixedSplitsWarning
from stereogenbench_data.datasets.mapped import SceneViews as SceneViews
from stereogenbench_data.datasets.mapped import SeekTableWarning as SeekTableWarning
from stereogenbench_data.datasets.mapped import StereoPairs as StereoPairs
from stereogenbench_data.datasets.streamed import StereoPairStream as StereoPairStream
from stereogenbench_data.errors import DescriptorError as DescriptorError
from stereogenbench_data.errors import EvaluationError as EvaluationError
from stereogenbench_data.errors import ExtraError as ExtraError
from stereogenbench_data.errors import FieldError as FieldError
from stereogenbench_data.errors import GeometryError as GeometryError
from stereogenbench_data.errors import MediaError as MediaError
from stereogenbench_data.errors import PassError as PassError
from stereogenbench_data.errors import PredictionError as PredictionError
from stereogenbench_data.errors import SchemaError as SchemaError
from stereogenbench_data.errors import SelectionError as SelectionError
from stereogenbench_data.errors import ShardError as ShardError
from stereogenbench_data.errors import StateError as StateError
from stereogenbench_data.errors import StereoGenBenchError as StereoGenBenchError
from stereogenbench_data.errors import StorageError as StorageError
from stereogenbench_data.errors import SynthesisError as SynthesisError
from stereogenbench_data.errors import WorkerError as WorkerError
from stereogenbench_data.evaluation.controls import score_controls as score_controls
from stereogenbench_data.evaluation.evaluate import evaluate as evaluate
from stereogenbench_data.evaluation.inputs import export_inputs as export_inputs
from stereogenbench_data.evaluation.protocol import EvaluationProtocol as EvaluationProtocol
from stereogenbench_data.evaluation.report import write_report as write_report
from stereogenbench_data.evaluation.tables import tables_of as tables_of
from stereogenbench_data.index.table import AssumptionWarning as AssumptionWarning
from stereogenbench_data.index.table import IncompleteSceneWarning as IncompleteSceneWarning
from stereogenbench_data.index.table import SceneIndex as SceneIndex
from stereogenbench_data.index.table import StaleIndexWarning as StaleIndexWarning
from stereogenbench_data.samples.fields import PAIR_FIELDS as PAIR_FIELDS
from stereogenbench_data.samples.fields import VIEW_FIELDS as VIEW_FIELDS
from stereogenbench_data.samples.fields import EnlargedSizeWarning as EnlargedSizeWarning
from stereogenbench_data.samples.fields import OddSceneWarning as OddSceneWarning
from stereogenbench_data.samples.fields import SwappedSizeWarning as SwappedSizeWarning
from stereogenbench_data.samples.transforms import ColorJitter as ColorJitter
from stereogenbench_data.samples.transforms import Compose as Compose
from stereogenbench_data.samples.transforms import Crop as Crop
from stereogenbench_data.samples.transforms import Eraser as Eraser
from stereogenbench_data.samples.transforms import HorizontalFlip as HorizontalFlip
from stereogenbench_data.samples.transforms import Letterbox as Letterbox
from stereogenbench_data.samples.transforms import RandomCrop as RandomCrop
from stereogenbench_data.samples.transforms import RandomScale as RandomScale
from stereogenbench_data.samples.transforms import Resize as Resize
from stereogenbench_data.schema.conventions import Conventions as Conventions
from stereogenbench_data.schema.records import DepthEncoding as DepthEncoding
from stereogenbench_data.selection.filters import FewerPairsWarning as FewerPairsWarning
from stereogenbench_data.sources.cache import ShardCache as ShardCache
from stereogenbench_data.sources.retry import RetryPolicy as RetryPolicy

__version__: str
