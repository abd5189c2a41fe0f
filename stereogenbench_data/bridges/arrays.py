"""From tensors back to arrays, for libraries that pass samples between processes by themselves."""

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import Sample


def to_arrays(sample: Sample) -> Sample:
    """Return a sample whose tensors are numpy arrays of the same dtype; texts stay.

    Raises:
        FieldError: If a field's tensor has no numpy counterpart.
    """
    try:
        return {
            name: value if isinstance(value, str) else value.numpy()
            for name, value in sample.items()
        }
    except TypeError as error:
        raise FieldError(f"a field cannot be given as a numpy array ({error}).") from error
