"""Index files that somebody made to take time or memory."""

import dataclasses
import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Member
from tests.hostile import run_bounded
from tests.index.test_table import METADATA, scene_of

OPEN = """
import sys
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.table import SceneIndex
# bounded
try:
    SceneIndex.open(sys.argv[1])
except StorageError as error:
    print(error)
"""


@pytest.fixture
def file(tmp_path):
    SceneIndex.from_scenes([scene_of(number) for number in range(3)], tmp_path).write(
        tmp_path / "index.parquet"
    )
    return tmp_path / "index.parquet"


def rewritten(file, table):
    """Write another table under the index's description of itself."""
    pq.write_table(
        table.replace_schema_metadata(pq.read_schema(file).metadata), file, compression="zstd"
    )


def with_texts(table, name, texts):
    place = table.schema.get_field_index(name)
    return table.set_column(place, table.schema.field(name), pa.array(texts))


def test_one_row_many_times_is_refused_by_the_footer(file):
    table = pq.read_table(file)
    rewritten(file, table.slice(0, 1).take(pa.array([0] * 200_000)))

    told = run_bounded(OPEN, file, memory_mb=600)

    assert "its 200,000 rows take" in told
    assert "may take" in told


def test_a_column_that_no_index_has_is_never_read(file):
    table = pq.read_table(file)
    rewritten(file, table.append_column("more", pa.array([b"x" * 2**28] * 3)))

    told = run_bounded(OPEN, file, memory_mb=400)

    assert "its columns are not those of an index (see more)" in told


def test_captions_of_300_mb_are_refused_by_the_footer(file):
    table = pq.read_table(file)
    rewritten(file, with_texts(table, "caption", ["x" * 300_000_000, "", ""]))

    told = run_bounded(OPEN, file, memory_mb=400)

    assert "its 3 rows take 300," in told


def test_one_long_caption_of_many_rows_is_added_up_before_it_is_spread_out(file):
    table = pq.read_table(file)
    many = table.slice(0, 1).take(pa.array([0] * 2_000))
    rewritten(file, with_texts(many, "caption", ["x" * 200_000] * 2_000))

    told = run_bounded(OPEN, file, memory_mb=600)

    assert "its 2,000 rows take 40" in told


def test_seek_tables_that_take_more_than_the_file_allows_are_as_good_as_none(file):
    table = pq.read_table(file)
    rewritten(file, table.append_column("seek_tables", pa.array([b"x" * 2**28] * 3)))

    told = run_bounded(
        "import sys\n"
        "from pathlib import Path\n"
        "from stereogenbench_data.index.parquet import read_seek_tables\n"
        "# bounded\n"
        "print(read_seek_tables(Path(sys.argv[1])))",
        file,
        memory_mb=400,
    )

    assert told == "None\n"


@pytest.mark.parametrize(
    ("name", "letters", "most"),
    [("map_name", 65_537, "65,536"), ("caption", 65_537, "65,536")],
)
def test_a_long_text_is_refused_with_its_length_alone(file, name, letters, most):
    table = pq.read_table(file)
    rewritten(file, with_texts(table, name, ["x" * letters, "b", "c"]))

    match = rf"{name} of a scene has {letters:,} letters, and it may have {most}"
    with pytest.raises(StorageError, match=match) as refused:
        SceneIndex.open(file)

    assert len(str(refused.value)) < 500


def test_more_frames_than_a_video_can_have_are_refused(file):
    table = pq.read_table(file)
    place = table.schema.get_field_index("frames")
    frames = pa.array([2**31, 5, 5])
    rewritten(file, table.set_column(place, table.schema.field("frames"), frames))

    with pytest.raises(StorageError, match="frames is 2147483648, not 1 to 131072"):
        SceneIndex.open(file)


def test_reasons_of_any_length_are_listed_by_their_start(file):
    table = pq.read_table(file)
    head = json.loads(table.schema.metadata[METADATA])
    head["broken"] = {f"scene {number}": "x" * 100_000 for number in range(50)}
    pq.write_table(table.replace_schema_metadata({METADATA: json.dumps(head)}), file)

    with pytest.warns(UserWarning, match="50 scenes cannot be used") as told:
        SceneIndex.open(file)

    assert len(str(told[0].message)) < 60_000


def test_a_size_above_the_bound_is_shown_beside_the_bound_in_full(tmp_path):
    scene = scene_of(0)
    members = {"a.mp4": Member("a.mp4", 0, 2**61 + 1)}

    with pytest.raises(StorageError, match="size is 2305843009213693953, not 0 to 230584300921369"):
        SceneIndex.from_scenes([dataclasses.replace(scene, members=members)], tmp_path)
