"""Two updates of training by each reward but CaRL's own, which other tests train by."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from carljax import build, metrics_log, train
from carljax.reward import reward
from carljax.reward.config import RewardConfig
from carljax.sim import towns
from carljax.sim.env import metric_names

DOCS = Path(__file__).resolve().parents[2] / "docs"
OTHERS = [name for name in reward.REWARDS if name != "carl"]
TINY = [
    *("--map", str(towns.path("village"))),
    *("--run.num-devices", "1", "--run.num-routes", "4", "--run.eval-routes", "0"),
    *("--reward.time-limit-s", "1", "--env.route-length", "300"),
    *("--env.num-pedestrians", "1", "--env.num-scenario-slots", "1"),
    *("--env.num-agents", "4"),
    *("--env.raster.height", "16", "--env.raster.width", "16"),
    *("--env.raster.ego-from-bottom-px", "4", "--network.hidden-size", "16"),
    *("--network.joint-size", "16", "--ppo.num-envs", "4", "--ppo.num-steps", "8"),
    *("--ppo.gamma", "0.99", "--ppo.num-minibatches", "2", "--ppo.micro-batch-size", "None"),
    *("--ppo.total-samples", "64", "--run.checkpoint-every", "2"),
]


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_it_trains_and_logs_its_own_terms(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, "--reward.name", name, "--run.dir", "run"]) == 0
    lines = metrics_log.read(tmp_path / "run")
    assert [line["update"] for line in lines] == [1, 2]
    names = metric_names(RewardConfig(name=name))
    assert set(names) <= set(lines[0])
    assert all(np.isfinite(line[metric]) for line in lines for metric in ("rollout/reward",))
    assert lines[-1]["episode/timeout_frac"] == 1.0  # after 11 steps
    assert {m for m in lines[0] if m.startswith("reward/")} <= set(names)
    saved = json.loads((tmp_path / "run" / "config.json").read_text())
    assert saved["reward"]["name"] == name
    made = build.setup(train.parse(["--resume", "run"]).config)
    assert made.env.reward_config.name == name


@pytest.mark.parametrize("name", OTHERS)
def test_every_number_it_logs_is_explained(name):
    text = (DOCS / "metrics.md").read_text() + (DOCS / "rewards.md").read_text()
    causes = set(re.findall(r"`episode/(\w+)_frac`", text))
    for metric in metric_names(RewardConfig(name=name)):
        assert f"`{metric}`" in text or metric.removeprefix("reward/") in causes, metric
