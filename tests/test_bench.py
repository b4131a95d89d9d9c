"""The benchmark's own arithmetic, its file of samples and the page it writes; no test here times anything."""

import doctest
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from benchmarks.bench import plan, runner, summary
from benchmarks.bench.work import buffers
from benchmarks.bench.work.flops import flops, off_policy, sac_by_hand
from tests.tiers import exhaustive

X = np.ones((32, 32), np.float32)
PRODUCT = 2 * 32**3
"""Operations of a product of two of them."""
OWN = {0: 100e-6, 1: 200e-6, 2: 150e-6}
"""Seconds of a step of rejeu by round; the peers' are multiples, by another factor in each round."""
FACTORS = {"sb3": {0: 30.0, 1: 10.0, 2: 20.0}, "sbx": {0: 3.0, 1: 5.0, 2: 4.0}}
PARTS = {"env": 0.2, "replay": 0.1, "update": 0.6, "rest": 0.1}
RATE = 100e9
"""Operations a second of the fastest product."""


def result_of(measurement, turn, variant):
    """What a measurement might have come to: rejeu's is ``OWN``, peers need a multiple, twice that with all threads."""
    seconds = OWN[turn] * FACTORS.get(measurement.library, {turn: 1.0})[turn]
    seconds *= 2.0 if variant == plan.ALL and measurement.library != "rejeu" else 1.0
    if measurement.name.startswith("peak"):
        return {"flops_per_second": RATE, "best": "xla 512", "rates": {"xla 512": RATE}}
    if measurement.case == "limits":
        return {"seconds_per_step": 10e-6}
    if measurement.case in ("steps", "rollouts"):
        found = {"seconds_per_step": seconds, "steps": 100, "seconds": 100 * seconds, "threads": 1}
        if measurement.library == "rejeu":
            found["seconds_by_part"] = {part: share * seconds for part, share in PARTS.items()}
            found |= {"update_flops": 3.9e6, "act_flops": 0.1e6} if turn == 0 and measurement.counts else {}
        return found
    if measurement.case == "parking":
        return {
            "training_steps_per_second": 1.0 / seconds,
            "seconds_in_env": 0.4 * seconds,
            "seconds_outside_env": 0.6 * seconds,
            "compile_seconds": 1.5,
            "success_rate": 0.1,
            "seconds_by_part": {part: share * seconds for part, share in PARTS.items()},
        }
    if measurement.case == "memory":
        return {"nbytes": 96_000_000, "resident": 97_000_000, "necessary": 85_000_000, "n": 1_000_000}
    return {"seconds": {"python": 0.01, "import": 1e4 * seconds, "first update, cold": 5.0, "first update, warm": 3.0}}


def sample(measurement, turn, variant):
    result = result_of(measurement, turn, variant)
    return {
        "key": measurement.key,
        "case": measurement.case,
        "name": measurement.name,
        "library": measurement.library,
        "variant": variant,
        "round": turn,
        "others_busy": 0.0,
        "wall_seconds": 1e5 * result.get("seconds_outside_env", 1e-5),
        "result": result,
        "calibration_ms": [0.5, 0.6],
    }


@pytest.fixture
def results():
    """A whole run of three rounds, in the second and third only the variant that was the fastest in the first."""
    samples = []
    for turn in range(3):
        for measurement in plan.everything():
            if measurement.rounds is None or turn < measurement.rounds:
                variants = runner.variants_of(measurement, turn, samples)
                samples += [sample(measurement, turn, variant) for variant in variants]
    return {
        "command": "scripts/bench",
        "settings": {"rounds": 3, "quick": False, "cases": list(plan.CASES), "libraries": list(plan.LIBRARIES)},
        "machine": {"processor": "A Processor", "cores": 2, "memory_gib": 8.0, "system": "Linux", "load_before": 0.1},
        "versions": {"rejeu": {"python": "3.11", "rejeu": "0.1.0"}, "sb3": {"torch": "2"}, "sbx": {"sbx-rl": None}},
        "samples": samples,
    }


def test_later_rounds_measure_the_variant_that_was_the_fastest_in_the_first(results):
    of = {(s["round"], s["variant"]) for s in results["samples"] if s["key"] == "steps/TD3/sb3"}
    assert of == {(0, plan.ONE), (0, plan.ALL), (1, plan.ONE), (2, plan.ONE)}
    assert [s["variant"] for s in summary.best(results["samples"], "steps", "TD3", "sb3")] == [plan.ONE] * 3


@pytest.mark.parametrize(
    ("function", "expected", "settings"),
    [
        (lambda a: a @ a, 1, {}),
        (lambda a: jax.lax.scan(lambda c, _: (c @ X, None), a, None, length=10)[0], 10, {}),
        (
            lambda a: jax.lax.scan(
                lambda c, _: (jax.lax.scan(lambda d, _: (d @ X, None), c, None, length=3)[0], None), a, None, length=5
            )[0],
            15,
            {},
        ),
        (
            lambda a: jax.lax.while_loop(lambda c: c[0] < 7, lambda c: (c[0] + 1, c[1] @ X), (jnp.int32(0), a)),
            7,
            {"while_runs": 7},
        ),
        (lambda a: jax.lax.cond(a[0, 0] > 0, lambda a: a @ X @ X, lambda a: a @ X, a), 1.25, {"expensive_share": 0.25}),
        (jax.jit(lambda a: jax.lax.scan(lambda c, _: (c @ X, None), a, None, length=4)[0]), 4, {}),
    ],
    ids=["product", "scan", "scan in scan", "while", "cond", "scan in jit"],
)
def test_operations_are_counted_through_loops_and_conditionals(function, expected, settings):
    assert flops(function, X, **settings) == pytest.approx(expected * PRODUCT, rel=1e-3)


@exhaustive
def test_the_count_of_an_update_is_that_by_hand_and_what_is_elementwise():
    agent = rejeu.SAC(
        "MlpPolicy", "Pendulum-v1", batch_size=64, policy_kwargs={"net_arch": [64, 64]}, buffer_size=1000, seed=0
    ).learn(50)
    # By hand: actor 3-64-64-2 has 4,416 weights, a critic 4-64-64-1 4,416. Per transition, in multiplications: the target
    # 4,416 + 2 * 4,416; the critics 2 * (3 * 4,416 - 4 * 64); the actor 3 * 4,416 - 3 * 64 through 2 * 2 * 4,416.
    by_hand = 2 * 64 * (13_248 + 25_984 + 13_056 + 17_664)
    assert sac_by_hand(3, 1, (64, 64), 64) == by_hand
    counted = off_policy(agent, 1)
    assert by_hand < counted["update_flops"] < 1.15 * by_hand
    assert 2 * 4_416 <= counted["act_flops"] < 1.15 * 2 * 4_416


def test_the_benchmarks_full_ring_is_one_that_episodes_would_have_made():
    from rejeu.replay.ring import Ring

    ring = buffers.rejeu_ring("parking", 505)
    played = Ring(505, 1, ring.obs_leaves, ring.obs_structure, (2,), np.float32, counters=("until_end",))
    obs = {leaf.path: np.zeros((1, 6), np.float32) for leaf in ring.obs_leaves}
    for _ in range(5):
        played.begin(obs)
        for _ in range(buffers.EPISODE):
            played.add(np.zeros((1, 2), np.float32), np.zeros(1, np.float32), np.zeros(1, bool), obs)
        played._close(0)
    for name in ("kind", "until_end", "head", "n_steps", "start"):
        np.testing.assert_array_equal(getattr(ring, name), getattr(played, name), err_msg=name)


@pytest.mark.parametrize("module", ["__main__", "machine", "summary", "text", "work.flops"], ids=lambda name: name)
def test_the_examples_of_the_benchmark_are_true(module):
    found = doctest.testmod(importlib.import_module(f"benchmarks.bench.{module}"))
    assert found.attempted > 0
    assert found.failed == 0
