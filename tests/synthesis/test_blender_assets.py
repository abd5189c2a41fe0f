"""``assets.toml``, without Blender: what is read, and what is refused in which words."""

import sys

import pytest

from stereogenbench_data.errors import ExtraError, SynthesisError
from stereogenbench_data.synthesis.blender.assets import read_assets
from stereogenbench_data.synthesis.blender.renderer import BlenderRenderer

LEAST = """\
[maps.Room]
file = "room.gltf"
[characters.Figure]
file = "figure.fbx"
[animations.Walk]
file = "figure.fbx"
"""
COMPLETE = f"""{LEAST}
[maps.Yard]
file = "maps/yard.blend"
scale = 0.01
light = "sky"
bounds_m = [[-5, -5, 0], [5, 5.5, 3]]
[characters.Other]
file = "figure.fbx"
forward = "+x"
[animations.Wave]
file = "figure.fbx"
take = "Wave"
rate_hz = 30
[sensors]
full_frame = [36.0, 24.0]
square = [23.76, 23.76]
[render]
samples_per_pixel = 8
device = "GPU"
denoise = false
threads = 2
"""


@pytest.fixture
def folder(tmp_path):
    """A folder of assets whose content only Blender would look at."""
    folder = tmp_path / "assets"
    (folder / "maps").mkdir(parents=True)
    (folder / "maps" / "yard.blend").write_bytes(b"BLENDER")
    (folder / "figure.fbx").write_bytes(b"Kaydara")
    (folder / "room.gltf").write_text("{}")
    return folder


def read(folder, text):
    path = folder / "assets.toml"
    path.write_text(text)
    return read_assets(path)


def test_everything_that_a_file_can_name_is_read(folder):
    assets = read(folder, COMPLETE)

    yard = assets.maps["Yard"]
    assert yard.file == str(folder / "maps" / "yard.blend")
    assert (yard.scale, yard.light) == (0.01, "sky")
    assert yard.bounds_m == ((-5.0, -5.0, 0.0), (5.0, 5.5, 3.0))
    assert [each.forward for each in assets.characters.values()] == ["-y", "+x"]
    wave = assets.animations["Wave"]
    assert (wave.take, wave.rate_hz, assets.animations["Walk"].take) == ("Wave", 30, None)
    assert assets.sensors_mm == ((36.0, 24.0), (23.76, 23.76))
    found = assets.settings
    told = (found.samples_per_pixel, found.device, found.denoise, found.threads)
    assert told == (8, "GPU", False, 2)
    room = assets.maps["Room"]  # of which nothing but the file is said
    assert (room.scale, room.light, room.bounds_m) == (1.0, "own", None)


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ('file = "room.gltf"', 'fiel = "room.gltf"', r"maps\.Room\.fiel.*unknown.*Choose.*file"),
        ('file = "room.gltf"', "", r"maps\.Room\.file: found None.*must name a file"),
        ('"room.gltf"', '"room.obj"', r"found 'room.obj'.*must name a file \(\.blend"),
        ('"room.gltf"', '"hall.gltf"', r"found 'hall.gltf'.*must exist"),
        ('"room.gltf"', '"../room.gltf"', r"found '../room.gltf'.*outside the folder.*Copy"),
        ("[maps.Room]", "[maps.'my room']", r"maps\.my room.*letters, digits and underscores"),
        ("[maps.Room]", "[map.Room]", r"assets.toml: map: this key is unknown.*maps"),
        ("[characters.Figure]", "[render]\ndevice = 'TPU'\n[characters.Figure]",
         r"render\.device: found 'TPU'.*CPU, GPU"),
        ("[characters.Figure]", "[render]\nsamples_per_pixel = 0\n[characters.Figure]",
         r"samples_per_pixel: found 0.*at least 1"),
        ("[characters.Figure]", "scale = -1\n[characters.Figure]",
         r"maps\.Room\.scale: found -1.*positive"),
        ("[characters.Figure]", "bounds_m = [[0, 0, 0], [1, -1, 1]]\n[characters.Figure]",
         r"bounds_m: found .*the smaller corner first"),
        ("[characters.Figure]", "[sensors]\nsmall = [0, 4]\n[characters.Figure]",
         r"sensors\.small: found \[0, 4\].*positive"),
        ("[animations.Walk]\nfile = \"figure.fbx\"", "", r"animations: found None.*one table"),
        ("[animations.Walk]", "[animations.Walk", r"is not TOML.*line 5"),
    ],
)  # fmt: skip
def test_what_does_not_follow_the_format_is_refused(folder, before, after, says):
    assert before in LEAST

    with pytest.raises(SynthesisError, match=says):
        read(folder, LEAST.replace(before, after))


def test_a_missing_file_of_assets_is_named(tmp_path):
    with pytest.raises(SynthesisError, match=r"none\.toml: cannot be read.*--assets"):
        read_assets(tmp_path / "none.toml")


def test_a_link_out_of_the_folder_is_refused(folder, tmp_path):
    (tmp_path / "elsewhere.blend").write_bytes(b"BLENDER")
    (folder / "room.blend").symlink_to(tmp_path / "elsewhere.blend")

    with pytest.raises(SynthesisError, match=r"maps\.Room\.file: found 'room.blend'.*outside"):
        read(folder, LEAST.replace("room.gltf", "room.blend"))


def test_the_digest_follows_every_file(folder):
    before = read(folder, LEAST).digest

    assert read(folder, LEAST).digest == before
    (folder / "figure.fbx").write_bytes(b"Kaydarb")
    assert read(folder, LEAST).digest != before


def test_a_python_without_blender_names_the_extra(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "bpy", None)
    (folder / "assets.toml").write_text(LEAST)

    with pytest.raises(ExtraError, match=r"Python 3\.13.*'stereogenbench-data\[blender\]'"):
        BlenderRenderer.from_file(folder / "assets.toml")
