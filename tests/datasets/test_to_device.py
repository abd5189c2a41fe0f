"""Batches on a device, and the loader's place while they are copied."""

import pytest
import torch

from stereogenbench_data import SceneViews, to_device


@pytest.fixture
def moments(small_release):
    return SceneViews(small_release, fields=("image", "stored_depth", "scene"), frames="all")


def test_on_the_processor_batches_pass_through(moments):
    loader = moments.loader(batch_size=4, seed=0)
    expected = list(loader)

    found = list(to_device(expected, "cpu"))

    assert len(found) == len(expected) == 7
    for batch, other in zip(found, expected, strict=True):
        assert batch.keys() == other.keys()
        assert all(batch[name] is other[name] for name in batch)


def test_tensors_go_to_the_device_and_texts_stay(moments):
    for batch in to_device(moments.loader(batch_size=4), "meta"):
        assert batch["image"].device.type == batch["stored_depth"].device.type == "meta"
        assert all(isinstance(scene, str) for scene in batch["scene"])


def test_the_state_of_the_loader_counts_what_the_loop_has_seen(moments):
    loader = moments.loader(batch_size=4, seed=0)
    seen = []
    for batch in to_device(loader, "cpu"):
        seen.append(batch["scene"])
        if len(seen) == 3:
            state = loader.state_dict()
            break

    resumed = moments.loader(batch_size=4, seed=0)
    resumed.load_state_dict(state)
    seen += [batch["scene"] for batch in to_device(resumed, "cpu")]

    assert seen == [batch["scene"] for batch in moments.loader(batch_size=4, seed=0)]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU with CUDA")
def test_copies_on_a_stream_of_their_own_are_whole(moments):
    expected = [batch["image"].clone() for batch in moments.loader(batch_size=4, seed=0)]
    loader = moments.loader(batch_size=4, seed=0, pin_memory=True)

    sums = []
    for batch in to_device(loader, "cuda"):
        busy = torch.ones(2048, 2048, device="cuda")
        for _ in range(20):
            busy = busy @ busy / 2048
        sums.append(batch["image"].long().sum() + 0 * busy.sum().long())

    assert [int(each) for each in sums] == [int(each.long().sum()) for each in expected]
