"""Index files that somebody made to take time or memory."""

import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.table import SceneIndex
from tests.hostile import run_bounded
from tests.index.test_table import altered, scene_of, written

OPEN = """
import sys
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.table import SceneIndex
# bounded
for file in sys.argv[1:]:
    try:
        SceneIndex.open(file)
    except StorageError as error:
        print(error)
"""


@pytest.fixture
def file(tmp_path):
    return written([scene_of(number) for number in range(3)], tmp_path)


def rewritten(file, table):
    """Write another table under the index's description of itself."""
    table = table.replace_schema_metadata(pq.read_schema(file).metadata)
    pq.write_table(table, file, compression="zstd")


def with_texts(table, name, texts):
    place = table.schema.get_field_index(name)
    return table.set_column(place, table.schema.field(name), pa.array(texts))


def test_tables_that_take_much_memory_are_refused_by_the_footer(file, tmp_path):
    table = pq.read_table(file)
    many = table.slice(0, 1).take(pa.array([0] * 2_000))
    long = {
        "its 200,000 rows take": table.slice(0, 1).take(pa.array([0] * 200_000)),
        "its columns are not those of an index (see more)":
            table.append_column("more", pa.array([b"x" * 150_000_000] * 3)),
        "its 3 rows take 300,": with_texts(table, "caption", ["x" * 300_000_000, "", ""]),
        "its 2,000 rows take 40": with_texts(many, "caption", ["x" * 200_000] * 2_000),
    }  # fmt: skip
    files = []
    for number, hostile in enumerate(long.values()):
        files.append(shutil.copy(file, tmp_path / f"{number}.parquet"))
        rewritten(files[-1], hostile)

    told = run_bounded(OPEN, *files, memory_mb=400)

    for line, found in zip(told.splitlines(), long, strict=True):
        assert found in line


def test_seek_tables_that_take_more_than_the_file_allows_are_as_good_as_none(file):
    table = pq.read_table(file)
    rewritten(file, table.append_column("seek_tables", pa.array([b"x" * 2**27] * 3)))

    told = run_bounded(
        "import sys\n"
        "from pathlib import Path\n"
        "from stereogenbench_data.index.parquet import read_seek_tables\n"
        "# bounded\n"
        "print(read_seek_tables(Path(sys.argv[1])))",
        file,
        memory_mb=300,
    )

    assert told == "None\n"


def test_a_long_text_is_refused_with_its_length_alone(file):
    table = pq.read_table(file)
    rewritten(file, with_texts(table, "caption", ["x" * 65_537, "b", "c"]))

    match = "caption of a scene has 65,537 letters, and it may have 65,536"
    with pytest.raises(StorageError, match=match) as refused:
        SceneIndex.open(file)

    assert len(str(refused.value)) < 500


def test_reasons_of_any_length_are_listed_by_their_start(file):
    reasons = {f"scene {number}": "x" * 100_000 for number in range(50)}
    altered(file, lambda table, head: head.update(broken=reasons))

    with pytest.warns(UserWarning, match="50 scenes cannot be used") as told:
        SceneIndex.open(file)

    assert len(str(told[0].message)) < 60_000
