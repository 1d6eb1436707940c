"""The benchmark suite: its statistics, counts, pairing and error lines. Nothing is timed here."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import compare
import jax
import jax.numpy as jnp
import matmul_flops
import measure
import pytest
import scaling
import throughput
import xla_cost
from measure import UsageError

from carljax import presets, timing
from carljax.ppo.conv import conv


def test_the_spread_is_median_extremes_and_quartiles():
    # In order 1 2 3 4 10: a quarter of the way is the second, three quarters the fourth.
    expected = {"median": 3.0, "min": 1.0, "q1": 2.0, "q3": 4.0, "max": 10.0, "num": 5}
    assert measure.spread([10.0, 1.0, 3.0, 2.0, 4.0]) == expected


def test_calls_are_timed_after_the_first_and_given_the_last_result(monkeypatch):
    seen, now = [], iter(range(100))
    monkeypatch.setattr(timing.time, "perf_counter", lambda: float(next(now)) ** 2)

    def function(x):
        seen.append(x)
        return x + 1

    given = lambda last: (0 if last is None else last,)  # noqa: E731
    # Clock readings 0 1 | 4 9 | 16 25 | 36 49: the first call is left out.
    assert timing.call_seconds(function, given, repeats=3) == [5.0, 9.0, 13.0]
    assert seen == [0, 1, 2, 3]


def flops_of(function, *args):
    return matmul_flops.of_traced(jax.jit(function).trace(*args), "cpu")


A, B = jnp.ones((3, 5), jnp.float32), jnp.ones((5, 7), jnp.float32)


def test_a_product_is_two_operations_for_each_of_its_multiplications():
    assert flops_of(jnp.matmul, A, B) == 2 * 3 * 5 * 7
    batch = jnp.ones((4, 5, 7), jnp.float32)
    assert flops_of(lambda a, b: jax.vmap(jnp.matmul, (None, 0))(a, b), A, batch) == 2 * 4 * 105


def test_a_convolution_leaves_out_its_padding():
    x, w = jnp.ones((2, 4, 4, 3), jnp.float32), jnp.ones((3, 3, 3, 8), jnp.float32)

    def plain(x, w, padding):
        numbers = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(x, w, (1, 1), padding, dimension_numbers=numbers)

    assert flops_of(lambda x, w: plain(x, w, "VALID"), x, w) == 2 * 2 * 8 * 3 * (2 * 3) ** 2
    # Along an axis the first and last outputs see 2 of the 3 taps: 2 + 3 + 3 + 2.
    assert flops_of(lambda x, w: plain(x, w, "SAME"), x, w) == 2 * 2 * 8 * 3 * (2 + 3 + 3 + 2) ** 2


def test_loops_count_as_often_as_they_run_and_only_the_platforms_own_branch_counts():
    def looped(x):
        def outer(x, _):
            return jax.lax.fori_loop(0, 5, lambda _, x: x @ x, x), None

        return jax.lax.scan(outer, x, None, length=7)[0]

    def either(x):
        return jax.lax.platform_dependent(x, cpu=lambda x: x @ x, default=lambda x: x @ x @ x)

    x = jnp.ones((4, 4), jnp.float32)
    assert flops_of(looped, x) == 35 * 2 * 4**3
    traced = jax.jit(either).trace(x)
    assert matmul_flops.of_traced(traced, "cpu") == 2 * 4**3
    assert matmul_flops.of_traced(traced, "gpu") == 2 * 2 * 4**3


@pytest.mark.parametrize("channels", [3, 12])
def test_the_gradient_of_our_convolution_counts_what_the_cpu_computes(channels):
    x, w = jnp.ones((2, 9, 9, channels)), jnp.ones((5, 5, channels, 4))
    traced = jax.jit(jax.grad(lambda x, w: conv(x, w, 2).sum(), (0, 1))).trace(x, w)
    forward = flops_of(lambda x, w: conv(x, w, 2), x, w)
    assert forward == 2 * 2 * 4 * channels * (3 * 5) ** 2
    # Either gradient is as much again; nobody asks for the value here.
    assert matmul_flops.of_traced(traced, "gpu") == 2 * forward
    # At stride 2 the CPU's input gradient is a convolution with 6 x 6 taps instead of 5 x 5. With
    # few channels its weight gradient multiplies, at 5 rows of the kernel, 2 x 3 rows of 3 blocks
    # of 4 pixels by the cotangents of 2 + 2 outputs.
    by_products = 2 * 5 * (2 * 3 * 3) * (4 * channels) * (4 * 4)
    weights = by_products if channels == 3 else forward
    assert matmul_flops.of_traced(traced, "cpu") == weights + forward * (6 / 5) ** 2


def test_xla_counts_a_loops_body_once_and_we_as_often_as_it_runs():
    def looped(x):
        def outer(x, _):
            return jax.lax.fori_loop(0, 5, lambda _, x: x @ x, x), None

        return jax.lax.scan(outer, x, None, length=7)[0]

    product = 2 * 64**3
    compiled = measure.jit(looped).trace(jnp.ones((64, 64))).lower().compile()
    assert compiled.cost_analysis()["flops"] == pytest.approx(product, rel=0.01)
    cost = xla_cost.of(compiled)
    assert (cost["loops"], cost["loops_of_unknown_length"]) == ("all runs", 0)
    assert cost["flops"] == pytest.approx(35 * product, rel=0.01)
    # A product reads two matrices and writes one; copies are at most another three.
    assert 3.0 <= cost["bytes"] / (35 * 4 * 64**2) <= 6.5


def test_a_loop_of_unknown_length_counts_once_and_is_reported():
    def until(x):
        return jax.lax.while_loop(lambda x: x.sum() < 1e9, lambda x: x @ x, x)

    compiled = measure.jit(until).trace(jnp.ones((64, 64))).lower().compile()
    cost = xla_cost.of(compiled)
    assert cost["loops_of_unknown_length"] == 1
    assert cost["flops"] == pytest.approx(2 * 64**3, rel=0.05)


def test_what_a_custom_call_runs_is_found():
    """XLA:CPU has a call of its own for the largest values, which names how to compare them."""

    def largest(x):
        return jax.lax.fori_loop(0, 3, lambda _, x: x * jax.lax.top_k(x, 2)[0].sum(), x)

    compiled = measure.jit(largest).trace(jnp.ones(64)).lower().compile()
    assert "TopK" in compiled.as_text()
    assert xla_cost.of(compiled)["loops"] == "all runs"


def test_a_workload_becomes_a_line(monkeypatch):
    monkeypatch.setattr(measure, "matmul_peak", lambda: 1000.0)
    monkeypatch.setattr(timing, "call_seconds", lambda *_: [4.0, 1.0, 2.0, 3.0, 5.0])
    workload = measure.Workload("product", measure.jit(jnp.matmul), (A, B), {"rows": 6}, {"n": 3})
    line = measure.run(workload, 5)
    assert (line["benchmark"], line["rows_per_s"], line["n"]) == ("product", 2.0, 3)
    assert line["matmul_flops"] == 210 and line["seconds"]["num"] == 5
    assert line["matmul_peak_share"] == pytest.approx(210 / 3.0 / 1000.0)
    json.dumps(line)
    with pytest.raises(UsageError, match="--repeats 4: a median needs at least 5"):
        measure.run(workload, 4)


STUB = """
import argparse, json, os, pathlib, sys
args = argparse.ArgumentParser()
args.add_argument("--kinds", nargs="*")
args.add_argument("--repeats")
args.add_argument("--scale", type=float, default=1.0)
args = args.parse_args()
side = pathlib.Path(os.environ["PYTHONPATH"]).name
with open(os.environ["STUB_LOG"], "a") as log:
    log.write(side + " ")
if side == "broken":
    sys.exit("the benchmark broke")
drift = len(open(os.environ["STUB_LOG"]).read().split())  # the machine gets slower and slower
speed = args.scale * {"base": 100.0, "new": 125.0}[side] / drift
for kind in args.kinds:
    line = {"benchmark": kind, "samples_per_s": speed, "matmul_peak_flops_per_s": 1.0}
    print(json.dumps(line))
print("not JSON")
"""


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """Three checkouts and a benchmark that knows which one it runs on."""
    for name in ("base", "new", "broken"):
        (tmp_path / name / "carljax").mkdir(parents=True)
        (tmp_path / name / "carljax" / "__init__.py").touch()
    (tmp_path / "stub.py").write_text(STUB)
    monkeypatch.setenv("STUB_LOG", str(tmp_path / "log"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_compare_runs_in_turn_and_pairs_what_drifts(stub, capsys):
    args = ["base", "new", "--kinds", "sim", "update", "--rounds", "4", "--script", "stub.py"]
    assert compare.main([*args, "--options=--scale 2"]) == 0
    assert (stub / "log").read_text().split() == "base new new base base new new base".split()
    out = capsys.readouterr().out.splitlines()
    lines = [json.loads(text) for text in out[::2]]
    assert [line["rate"] for line in lines] == ["sim samples_per_s", "update samples_per_s"]
    # Base ran 1st, 4th, 5th, 8th: 200, 50, 40, 25. New ran 2nd, 3rd, 6th, 7th.
    assert lines[0]["base_median"] == pytest.approx(45.0)
    assert lines[0]["new_median"] == pytest.approx((250 / 3 + 250 / 6) / 2)
    assert lines[0]["paired"]["min"] == pytest.approx(1.25 / 2)
    assert lines[0]["paired"]["max"] == pytest.approx(1.25 * 4 / 3)
    assert out[1].startswith("sim samples_per_s: NEW / BASE = 1.389 (95 %")


def test_the_interval_is_students_of_the_logarithms():
    # Logarithms 0, 0.1, 0.2: mean 0.1, deviation 0.1; t(0.975, 2) = 4.3027, over sqrt(3) 2.4842.
    low, high = compare.interval([math.exp(x) for x in (0.0, 0.1, 0.2)])
    assert math.log(low) == pytest.approx(0.1 - 0.24842, abs=1e-4)
    assert math.log(high) == pytest.approx(0.1 + 0.24842, abs=1e-4)


@pytest.mark.parametrize(
    ("ratios", "verdict"),
    [
        ((1.2, 1.21, 1.19), "NEW is faster"),
        ((0.8, 0.81, 0.79), "NEW is slower"),
        ((0.8, 1.3, 1.0), "no difference shown"),
    ],
)
def test_a_verdict_needs_the_whole_interval(ratios, verdict):
    rounds = [({"sim x_per_s": 10.0}, {"sim x_per_s": 10.0 * ratio}) for ratio in ratios]
    (line,) = compare.compare(rounds)
    assert compare.sentence(line).endswith(verdict)


@pytest.mark.parametrize(
    ("args", "reason"),
    [
        (["base", "nowhere"], "nowhere: is neither a directory nor a git revision"),
        (["base", "."], ".: there is no package carljax in it"),
        (["base", "new", "--rounds", "2"], "--rounds 2: is below the least, 3"),
        (["base", "new", "--script", "no.py"], "--script no.py: there is no such file"),
        (["base", "broken"], "broken: stub.py failed: the benchmark broke"),
        (["base", "new", "--own-scripts"], "base: there is no benchmarks/throughput.py in it"),
    ],
)
def test_compare_says_in_one_line_what_is_wrong(stub, capsys, args, reason):
    script = [] if "--script" in args else ["--script", "stub.py"]
    assert compare.main([*args, *script]) == 2
    errors = [e for e in capsys.readouterr().err.splitlines() if not e.startswith("round ")]
    assert len(errors) == 1 and errors[0].startswith(f"error: {reason}")


def test_a_revision_is_unpacked(tmp_path):
    git = ["git", "-C", str(compare.ROOT), "rev-parse", "HEAD"]
    if subprocess.run(git, capture_output=True, check=False).returncode:
        pytest.skip("the tests run outside of a git repository")
    root = compare.checkout("HEAD", tmp_path / "there")
    assert (root / "carljax" / "sim" / "env.py").is_file()


def point(size, cost):
    return {"series": "sim", "size": size, "cost_s": cost}


def test_growth_is_judged_from_where_the_cores_are_full():
    # Throughput 10, 16, 19, 20, 18.2: within a fifth of the best from 2 on (16 = 0.8 x 20).
    points = [point(1, 0.1), point(2, 0.125), point(4, 4 / 19), point(8, 0.4), point(16, 0.88)]
    points = list(scaling.with_ratios(iter(points)))
    assert points[0]["cost_ratio"] is None
    assert points[1]["cost_ratio"] == pytest.approx(1.25)
    verdict = scaling.judge("envs", points)
    assert verdict["full_from"] == 2 and verdict["holds"] is True
    assert verdict["largest_for_double"] == pytest.approx(2.2)
    # Four times the size at 4.8 times the cost is twice at sqrt(4.8) = 2.19.
    assert scaling.per_double({"size_ratio": 4.0, "cost_ratio": 4.8}) == pytest.approx(4.8**0.5)
    slow = list(scaling.with_ratios(iter([point(1, 1.0), point(2, 2.3)])))
    assert scaling.judge("agents", slow)["holds"] is False
    assert scaling.judge("devices", slow)["holds"] is None


def test_devices_are_made_in_processes_of_their_own(monkeypatch, capsys):
    seen = []

    def run(command, env, **_):
        seen.append((command[-6:], env["XLA_FLAGS"].split()[-1], env["JAX_PLATFORMS"]))
        line = {"benchmark": "end_to_end", "seconds": {"median": 2.0}, "machine": "the child's"}
        return subprocess.CompletedProcess(command, 0, json.dumps(line), "")

    monkeypatch.setattr(scaling.subprocess, "run", run)
    monkeypatch.setattr(measure, "matmul_peak", lambda: 1.0)
    monkeypatch.setattr(measure.machine, "describe", dict)
    args = ["--axes", "devices", "--devices", "1", "2", "--repeats", "6"]
    monkeypatch.setattr(sys, "argv", ["scaling", *args])
    assert scaling.main() == 0
    flag = "--xla_force_host_platform_device_count"
    asked = ["--num-devices", "2", "--repeats", "6", "--num-routes", "32"]
    assert seen[1] == (asked, f"{flag}=2", "cpu")
    lines = [json.loads(text) for text in capsys.readouterr().out.splitlines()]
    assert [line.get("cost_ratio") for line in lines] == [None, 1.0, None]
    assert lines[1]["machine"] == "the child's" and lines[1]["size"] == 2
    assert lines[2]["holds"] is None


def test_points_are_compared_within_their_series():
    points = [point(1, 1.0), point(1, 5.0) | {"series": "render"}, point(2, 3.0)]
    ratios = [p["cost_ratio"] for p in scaling.with_ratios(iter(points))]
    assert ratios == [None, None, 3.0]


def test_points_are_timed_in_turn_with_the_one_before(monkeypatch):
    """So that a machine which slows down to a quarter meanwhile changes no ratio."""
    slow = [4.0 ** (k / 50) for k in range(100)]
    workloads = [measure.Workload("sim", None, (), {}, {"seconds": s}) for s in (1.0, 2.0)]

    def call(ready, repeats, warm_up=1):
        return [ready.sizes["seconds"] * slow.pop(0) for _ in range(warm_up + repeats)][warm_up:]

    monkeypatch.setattr(measure, "prepare", lambda workload: workload)
    monkeypatch.setattr(measure, "call", call)
    monkeypatch.setattr(measure, "describe", lambda _, s: {"seconds": measure.spread(s)})
    last, command = {}, scaling.Command(num_steps=10)
    first, second = (scaling.point(command, w, 8, last) for w in workloads)
    assert first["seconds"]["num"] == second["seconds"]["num"] == command.repeats
    assert "cost_ratio" not in first and second["cost_ratio"] == pytest.approx(2.0, rel=1e-3)
    assert second["cost_s"] / first["cost_s"] > 2.2


@pytest.mark.parametrize(
    ("module", "args", "reason"),
    [
        (throughput, ["--repeats", "4"], "--repeats 4: a median needs at least 5"),
        (throughput, ["--kinds", "update", "--num-envs", "0"], "ppo.num_envs must be at least 1"),
        (
            throughput,
            ["--num-devices", "2"],
            "--num-devices 2: is for --kinds end_to_end alone",
        ),
        (
            throughput,
            ["--kinds", "end_to_end", "--num-devices", "64"],
            "64 devices were asked for, but there are",
        ),
        (scaling, ["--agents", "8", "4"], "--agents 8 4: must rise from 1 or more"),
        (scaling, ["--num-steps", "0"], "--num-steps 0: is below 1"),
        (scaling, ["--axes", "maps", "--maps", "no.xodr"], "--maps: "),
    ],
)
def test_bad_input_is_one_line_and_status_2(monkeypatch, capsys, module, args, reason):
    monkeypatch.setattr(sys, "argv", ["benchmark", *args])
    monkeypatch.setattr(throughput.build, "load_towns", lambda maps: [])
    assert module.main() == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1 and error[0].startswith("error: ") and reason in error[0]


def test_a_presets_sizes_can_be_changed():
    config = throughput.configure(throughput.Command(num_envs=256))
    assert config.ppo.num_envs == 256
    assert config.ppo.num_steps == presets.CPU.ppo.num_steps
    # Eight devices have 32 x 512 / 4 / 8 = 512 samples each of a minibatch.
    made = {"preset": "carl-carla", "kinds": ("end_to_end",)}
    command = throughput.Command(**made, num_envs=32, num_devices=8)
    assert throughput.configure(command).ppo.micro_batch_size == 512
