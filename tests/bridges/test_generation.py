"""Generation: items as GenStereo's loop takes them, and clips for video diffusion."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from stereogenbench_data import FieldError, HorizontalFlip, Letterbox, SelectionError, StereoPairs
from stereogenbench_data.bridges.generation import GenStereo, StereoClips
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import OddSceneWarning
from tests.servers.tools import require_module
from tests.shards.shard_files import scenes_of

FIELDS = ("left", "right", "disparity", "valid", "warped_right", "hole")


def in_unit_range(pictures):
    return (pictures.float() / 255 - 0.5) / 0.5


@pytest.fixture(scope="module")
def item(detailed_release):
    return GenStereo(detailed_release)[0]


def test_a_batch_of_genstereo_has_what_its_loop_reads(indexed_release):
    batch = next(iter(GenStereo(indexed_release, split="train").loader(batch_size=2)))

    assert {name: (tuple(value.shape), value.dtype) for name, value in batch.items()} == {
        "source": ((2, 3, 64, 64), torch.float32),
        "correspondence": ((2, 1, 64, 64), torch.float32),
        "target": ((2, 3, 64, 64), torch.float32),
        "src_coords_embed": ((2, 14, 64, 64), torch.float32),
        "trg_coords_embed": ((2, 14, 64, 64), torch.float32),
        "clip_images": ((2, 3, 224, 224), torch.float32),
        "converted_right": ((2, 3, 64, 64), torch.float32),
        "mask": ((2, 1, 64, 64), torch.uint8),
    }
    for name in ("source", "target", "converted_right"):
        assert -1 <= batch[name].min() < -0.5 < 0.5 < batch[name].max() <= 1


@pytest.mark.parametrize("transform", [None, HorizontalFlip(1.0), Letterbox(160, 240)])
def test_the_warped_view_and_the_mask_are_the_fields(detailed_release, transform):
    plain = StereoPairs(detailed_release, fields=FIELDS, transform=transform)[0]
    item = GenStereo(detailed_release, transform=transform)[0]

    assert torch.equal(item["mask"] == 1, plain["hole"])
    assert torch.equal(item["converted_right"], in_unit_range(plain["warped_right"]))
    assert (item["converted_right"][:, plain["hole"][0]] == -1).all()
    assert torch.equal(item["correspondence"], plain["disparity"])
    assert torch.equal(item["source"], in_unit_range(plain["left"]))
    assert torch.equal(item["target"], in_unit_range(plain["right"]))


def test_genstereo_refuses_rigs_that_are_not_rectified_by_name(detailed_release):
    (scene,) = scenes_of(detailed_release).values()
    turned = SceneIndex.from_scenes([replace(scene, rig_residual_px=3.5)], detailed_release)

    with pytest.warns(OddSceneWarning), pytest.raises(SelectionError, match=r"off by 3\.5 px"):
        GenStereo(turned)


def test_embedded_coordinates_say_where_a_warped_pixel_came_from(item):
    embedded = item["trg_coords_embed"]
    seen = item["mask"][0] == 0
    rows, columns = torch.nonzero(seen, as_tuple=True)
    x, y = (embedded[axis][seen] * 160 for axis in (0, 1))
    source_columns = x.round().long()

    torch.testing.assert_close(x, source_columns.float(), atol=1e-3, rtol=0)
    torch.testing.assert_close(y, rows.float(), atol=1e-3, rtol=0)
    moved = item["correspondence"][0, rows, source_columns]
    assert ((source_columns - columns) - moved).abs().max() <= 0.5 + 1e-4
    torch.testing.assert_close(embedded[2][seen], torch.sin(embedded[0][seen]))
    torch.testing.assert_close(embedded[9][seen], torch.cos(2 * embedded[1][seen]))
    assert (embedded[:10, ~seen] == 0).all()
    assert torch.equal(embedded[10], item["mask"][0].float())
    assert torch.equal(embedded[11:], item["converted_right"])
    assert (item["src_coords_embed"][10] == 0).all()
    assert torch.equal(item["src_coords_embed"][11:], item["source"])


@pytest.mark.parametrize("size", [(120, 200), (200, 120)])
@pytest.mark.filterwarnings("ignore::stereogenbench_data.samples.fields.SwappedSizeWarning")
def test_clip_is_given_what_its_own_processor_makes(detailed_release, size):
    transformers = require_module("transformers")
    left = StereoPairs(detailed_release, fields=("left",), size=size)[0]["left"]
    kind = getattr(transformers, "CLIPImageProcessorPil", None) or transformers.CLIPImageProcessor
    picture = Image.fromarray(left.permute(1, 2, 0).numpy())

    made = kind()(images=picture, return_tensors="pt").pixel_values[0]

    found = GenStereo(detailed_release, size=size)[0]["clip_images"]
    torch.testing.assert_close(found, torch.as_tensor(np.asarray(made)), atol=1e-5, rtol=0)


@pytest.mark.parametrize("layout", ["tchw", "cthw"])
def test_clips_have_time_and_channels_in_the_order_asked(indexed_release, layout):
    options = {"split": "train", "pairs": "adjacent", "frames": ("clips", 3)}
    plain = StereoPairs(indexed_release, fields=FIELDS, **options)[4]

    clip = StereoClips(indexed_release, layout=layout, **options)[4]

    shape = (3, 3, 64, 64)
    assert clip["source"].shape == clip["target"].shape == clip["warped"].shape == shape
    as_stored = {
        name: clip[name].transpose(0, 1) if layout == "cthw" else clip[name]
        for name in ("source", "target", "warped", "mask", "correspondence")
    }
    views = {"source": "left", "target": "right", "warped": "warped_right"}
    for name, field in views.items():
        assert torch.equal(as_stored[name], in_unit_range(plain[field]))
    assert torch.equal(as_stored["mask"], plain["hole"].float())
    assert torch.equal(as_stored["correspondence"], plain["disparity"])
    assert all(clip[name].is_contiguous() for name in as_stored)


def test_clips_tell_their_caption_baseline_and_rate(indexed_release):
    options = {"split": "train", "family": "Uniform", "frames": ("clips", 3, 2)}
    plain, told = (
        StereoClips(indexed_release, captions=captions, **options)[0]
        for captions in ("plain", "with baseline")
    )

    scene = StereoPairs(indexed_release, **options).index.scene(1)
    centimetres = float(plain["baseline_m"]) * 100
    assert plain["caption"].startswith("A figure walks")
    assert told["caption"] == f"{plain['caption']} Stereo baseline {centimetres:.1f} cm."
    assert float(plain["frame_rate_hz"]) == scene.frame_rate_hz / 2 > 0


def test_what_cannot_be_is_refused(indexed_release):
    with pytest.raises(FieldError, match=r"layout must be one of .*'cthw'.*, got 'thwc'"):
        StereoClips(indexed_release, layout="thwc", frames=("clips", 2))
    with pytest.raises(FieldError, match=r"captions must be one of .*'plain'.*, got 'long'"):
        StereoClips(indexed_release, captions="long", frames=("clips", 2))
    with pytest.raises(SelectionError, match="StereoClips takes clips"):
        StereoClips(indexed_release)
    with pytest.raises(SelectionError, match="GenStereo takes frames"):
        GenStereo(indexed_release, frames=("clips", 2))
