"""``stereogenbench audit``: what it prints, writes and returns."""

import json

import pytest

from stereogenbench_data.audit.geometry import audit as geometry_audit
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE
from tests.audit.corruption import copied, pictures_of
from tests.cli.command import invoke

SCENE = "train/Uniform/SynthStage/scene_000000"
FEW = ("--workers", "1", "--per-scene", "1", "--where", f"scene={SCENE}")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run the command with a cache of its own."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return lambda *words: invoke("audit", *words)


def test_data_that_are_right_are_reported_as_a_table_with_exit_code_0(small_shards, run):
    result = run(small_shards, *FEW[:2], "--per-scene", "all", *FEW[4:])

    assert result.exit_code == 0
    assert "1 of 4 scenes, all frames of each." in result.stdout
    assert "| 0 px | 0 px | 0.001 px |" in result.stdout
    assert "7/7 frames" in result.stderr


def test_a_finding_ends_with_exit_code_1_and_json_is_all_that_stdout_gets(
    small_release, run, tmp_path
):
    pictures_of(0, lambda seen: seen // 30)(copied(small_release / SCENE, tmp_path / "data"))

    result = run(tmp_path / "data", *FEW, "--json", "-o", tmp_path / "a.md")

    assert result.exit_code == 1
    assert json.loads(result.stdout)["findings"][0]["check"] == "too dark"
    assert f"- {SCENE}/cam_00_rgb.mp4: too dark: " in (tmp_path / "a.md").read_text()


def test_a_stopped_audit_keeps_its_results_and_the_next_run_uses_them(
    small_shards, run, monkeypatch, tmp_path
):
    plain, audited = geometry_audit.audit_scene, []

    def audit_some(task, after_bytes):
        if len(audited) == limit:
            raise KeyboardInterrupt
        audited.append(task.scene.id.key)
        return plain(task, after_bytes)

    monkeypatch.setattr(geometry_audit, "audit_scene", audit_some)
    limit = 1
    stopped = run(small_shards, "--workers", "1", "--per-scene", "1")
    kept = [*(tmp_path / "cache").rglob("audit-*/*/*")]
    limit = 4
    again = run(small_shards, "--workers", "1", "--per-scene", "1")

    assert stopped.exit_code == 130
    assert "stopped; run the same command again to go on" in stopped.stderr
    assert len(kept) == 1
    assert again.exit_code == 0
    assert len(audited) == len(set(audited)) == 4
    assert not kept[0].exists()


def test_a_filter_that_no_folder_matches_says_what_folders_there_are(small_release, run):
    there = (
        "none of its 4 scenes matches; there are scenes in eval/MapSeenInTrain/Uniform/"
        "SynthStage, train/IPD_Gaussian/SynthStage, train/Uniform/SynthStage. Check the filters"
    )
    refused = run(small_release, "--workers", "1", "--where", "family=uniform")

    assert refused.exit_code == 2
    assert there in refused.stderr
