"""Folders of a sweep are named by what was swept."""

from __future__ import annotations

from omegaconf import OmegaConf

from hno.cli.swept import file_name, named, swept_keys


def test_what_differs_between_jobs_is_swept_in_its_order() -> None:
    words = ["experiment=smoke", "optimizer=soap,adam", "seed=0,1", "sampler=mixed,uniform", "++optimizer.lr=1e-3,1e-2"]
    assert swept_keys([*words, "game=drone,narrow_road", "logger=csv"], {}) == ["optimizer", "sampler", "optimizer.lr"]
    assert swept_keys(["trainer.max_steps=range(1,4)"], {"network": "deeponet,mlp"}) == ["network", "trainer.max_steps"]
    assert swept_keys(["data.types=[[1,1],[5,5]]"], {}) == []


def test_folders_have_the_chosen_values_in_their_names() -> None:
    hydra = {"job": {"num": 3}, "runtime": {"choices": {"optimizer": "soap"}}}
    config = OmegaConf.create({"hydra": hydra, "optimizer": {"lr": 0.001}})
    config.subdir = named("${hydra.job.num}_drone", ["optimizer", "optimizer.lr"], ["optimizer", "sampler"])
    assert config.subdir == "3_drone_optimizer-soap_lr-0.001"


def test_any_value_is_the_name_of_a_file() -> None:
    for value in ("a/b/best.ckpt", [[1, 1], [5, 5]], "", None, "../..", "x" * 500, "a b=c'\"$"):
        name = file_name(value)
        assert name
        assert "/" not in name
        assert len(name) <= 30
        assert not set(name) & set(" ='\"$[],")
