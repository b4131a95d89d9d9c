"""Compares PPO in one program, with 2,048 environments on one core, with Rejax, jaxnasium and rl2xla.

    python benchmarks/many_environments.py --rejax-python PATH --jaxnasium-python PATH --rl2xla-python PATH
    python benchmarks/many_environments.py --cases 64-64 --libraries rejeu rejax --rejax-python PATH --rounds 1

CartPole of each library, rollouts of 128 steps, four epochs of four minibatches, separate networks of actor and critic with
tanh, Adam with a constant rate, no evaluations. ``measurements.md`` says what remains different.

Each library has a process of its own, pinned to one core and with one thread. The processes take turns: each takes one rollout
and learns from it while the others wait, so that work beside them slows all alike. The first rollout, which compiles, does not
count. Ratios are those of the turns of a round, and the result is their median. It is written to
``benchmarks/results/many_environments.json``.

Rejax 0.1.3 needs a version of gymnax below 1.0, so each peer has a Python of its own::

    python -m venv PEER && PEER/bin/pip install rejax==0.1.3 "gymnax<1.0"
    python -m venv PEER && PEER/bin/pip install "jaxnasium[algs]==0.1.1"
    python -m venv PEER && PEER/bin/pip install rl2xla==0.1.0
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from statistics import median
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import machine, provenance, write

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "benchmarks" / "results" / "many_environments.json"
N_ENVS, N_STEPS, N_EPOCHS, N_MINIBATCHES = 2_048, 128, 4, 4
ROLLOUT = N_ENVS * N_STEPS
RATE, GAMMA, GAE_LAMBDA, ENT_COEF, VF_COEF, CLIP, MAX_NORM = 3e-4, 0.99, 0.95, 0.01, 0.5, 0.2, 0.5
CASES = {"64-64": (64, 64), "256-256": (256, 256)}
"""Widths of the hidden layers."""
PACKAGES = {
    "rejeu": ("jax", "jaxlib", "equinox", "optax"),
    "rejax": ("rejax", "gymnax", "jax", "jaxlib", "flax", "optax"),
    "jaxnasium": ("jaxnasium", "jax", "jaxlib", "equinox", "optax"),
    "rl2xla": ("rl2xla", "gymnasium", "jax", "jaxlib", "flax", "optax"),
}
Turn = Callable[[], bool]
"""Reports a rollout, and waits; returns whether there is another."""


def rejeu(widths: tuple[int, ...], turn: Turn) -> None:
    import rejeu

    agent = rejeu.PPO(
        "MlpPolicy",
        rejeu.make_vector("jax/CartPole-v1", N_ENVS),
        seed=0,
        learning_rate=RATE,
        gamma=GAMMA,
        gae_lambda=GAE_LAMBDA,
        ent_coef=ENT_COEF,
        vf_coef=VF_COEF,
        clip_range=CLIP,
        clip_range_vf=CLIP,
        max_grad_norm=MAX_NORM,
        n_steps=N_STEPS,
        n_epochs=N_EPOCHS,
        batch_size=ROLLOUT // N_MINIBATCHES,
        policy_kwargs={"net_arch": [*widths], "activation_fn": "tanh"},
    )
    agent.on_device = True
    agent.learn(10**9, lambda agent, progress: not progress.rollout_ended or turn())


def rejax(widths: tuple[int, ...], turn: Turn) -> None:
    import jax
    import rejax

    algorithm = rejax.PPO.create(
        env="CartPole-v1",
        learning_rate=RATE,
        gamma=GAMMA,
        gae_lambda=GAE_LAMBDA,
        ent_coef=ENT_COEF,
        vf_coef=VF_COEF,
        clip_eps=CLIP,
        max_grad_norm=MAX_NORM,
        num_envs=N_ENVS,
        num_steps=N_STEPS,
        num_epochs=N_EPOCHS,
        num_minibatches=N_MINIBATCHES,
        agent_kwargs={"hidden_layer_sizes": widths, "activation": "tanh"},
        total_timesteps=ROLLOUT,
        eval_freq=ROLLOUT,
        skip_initial_evaluation=True,
    ).replace(eval_callback=lambda algorithm, state, key: ())
    train = jax.jit(lambda state: algorithm.train(train_state=state)[0], donate_argnums=0)
    state = train(jax.jit(algorithm.init_state)(jax.random.PRNGKey(0)))
    while jax.block_until_ready(state) and turn():
        state = train(state)


def jaxnasium(widths: tuple[int, ...], turn: Turn) -> None:
    import jax
    import jaxnasium
    from jaxnasium.algorithms import PPO
    from jaxnasium.algorithms.architectures import MLP

    env = jaxnasium.make("CartPole-v1")
    network = {"body": MLP.with_params(hidden_sizes=widths, activation=jax.numpy.tanh)}
    algorithm = PPO(
        learning_rate_start=RATE,
        gamma=GAMMA,
        gae_lambda=GAE_LAMBDA,
        ent_coef_start=ENT_COEF,
        ent_coef_end=None,
        vf_coef=VF_COEF,
        clip_coef=CLIP,
        clip_coef_vf=CLIP,
        max_grad_norm=MAX_NORM,
        num_envs=N_ENVS,
        num_steps=N_STEPS,
        num_epochs=N_EPOCHS,
        num_minibatches=N_MINIBATCHES,
        total_timesteps=ROLLOUT,
        warmup_steps=1,
        normalize_observations=False,
        normalize_rewards=False,
        actor_kwargs=network,
        critic_kwargs=network,
        log_function=None,
        reduce_metrics_fn=lambda metrics: (),
    )
    agent, key = algorithm.init_agent(jax.random.PRNGKey(0), env), jax.random.PRNGKey(1)
    agent = algorithm.train(key, env, agent=agent)[0]
    while jax.block_until_ready(jax.tree.leaves(agent)) and turn():
        agent = algorithm.train(key, env, agent=agent)[0]


def rl2xla(widths: tuple[int, ...], turn: Turn) -> None:
    """Calls the kernels of the library's trainer as its ``train`` does, in one program.

    Its policy is normal, one number of which the sign is the action: there is no other for discrete actions.
    """
    import jax
    import jax.numpy as jnp
    import optax
    from flax import linen as nn
    from rl2xla import PPOConfig, compile_ppo, gym_to_jax

    class Network(nn.Module):
        @nn.compact
        def __call__(self, obs: Any) -> Any:
            heads = []
            for _ in range(2):
                x = obs
                for width in widths:
                    x = nn.tanh(nn.Dense(width)(x))
                heads.append(nn.Dense(1)(x))
            log_std = self.param("log_std", nn.initializers.zeros, (1,))
            return heads[0], jnp.broadcast_to(log_std, heads[0].shape), heads[1][..., 0]

    reset, step = gym_to_jax("CartPole-v1")
    network = Network()
    trainer = compile_ppo(reset, lambda state, action: step(state, (action > 0).astype(jnp.int32)), network)
    config = PPOConfig(
        N_ENVS, N_STEPS, 1, N_EPOCHS, ROLLOUT // N_MINIBATCHES, GAMMA, GAE_LAMBDA, CLIP, RATE, VF_COEF, ENT_COEF
    )
    optimizer = optax.adam(RATE)
    trainer._build_kernels(config, optimizer)

    def begin(key: Any) -> Any:
        params = network.init(key, jnp.zeros((1, 4)))
        return *jax.vmap(reset)(jax.random.split(key, N_ENVS)), params, optimizer.init(params), key

    def train(carry: Any) -> Any:
        states, obs, params, optimizer_state, key = carry
        key, rollout_key, epoch_key = jax.random.split(key, 3)
        (states, obs, params), steps = trainer._collect(states, obs, params, rollout_key)
        last_value = network.apply(params, obs)[2]
        advantages, returns = trainer._gae(steps.rewards, steps.values, steps.dones, last_value)
        data = jax.tree.map(
            lambda x: x.reshape(-1, *x.shape[2:]), (steps.obs, steps.actions, steps.log_probs, returns, advantages)
        )
        for _ in range(config.epochs):
            params, optimizer_state, epoch_key, _ = trainer._run_epoch(params, optimizer_state, epoch_key, *data)
        return states, obs, params, optimizer_state, key

    train = jax.jit(train, donate_argnums=0)
    carry = train(jax.jit(begin)(jax.random.PRNGKey(0)))
    while jax.block_until_ready(carry) and turn():
        carry = train(carry)


TRAINERS = {"rejeu": rejeu, "rejax": rejax, "jaxnasium": jaxnasium, "rl2xla": rl2xla}


def child(case: str, library: str, core: int) -> None:
    """Takes a rollout for each line of standard input, and prints what each took as a line of JSON."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    import jax

    compiled, began = [0.0], [time.perf_counter(), time.process_time()]
    results, sys.stdout = sys.stdout, sys.stderr  # which libraries may print to

    def listen(event: str, seconds: float, **_: object) -> None:
        if event.startswith("/jax/core/compile/"):
            compiled[0] += seconds

    jax.monitoring.register_event_duration_secs_listener(listen)

    def turn() -> bool:
        wall, processor = time.perf_counter() - began[0], time.process_time() - began[1]
        row = {"wall_seconds": wall, "processor_seconds": processor, "compile_seconds": compiled[0]}
        print(json.dumps({**row, "versions": versions}), file=results, flush=True)
        compiled[0], goes_on = 0.0, bool(sys.stdin.readline())
        began[:] = time.perf_counter(), time.process_time()
        return goes_on

    versions = {"python": platform.python_version()} | {name: metadata.version(name) for name in PACKAGES[library]}
    TRAINERS[library](CASES[case], turn)


class Process:
    """A library that trains in a process of its own."""

    def __init__(self, case: str, library: str, python: str, core: int) -> None:
        environment = {
            **os.environ,
            "JAX_PLATFORMS": "cpu",
            "JAX_COMPILATION_CACHE_DIR": "",
            "PYTHONWARNINGS": "ignore",
        }
        environment |= dict.fromkeys(("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        environment["PYTHONPATH"] = str(ROOT / "src") if library == "rejeu" else ""
        words = [python, __file__, "--child", json.dumps([case, library, core])]
        self.case, self.library = case, library
        self.process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self.first = self._read()
        """Of the first rollout, which compiles."""

    def take(self) -> dict[str, Any]:
        """Returns the seconds of one more rollout."""
        assert self.process.stdin
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self._read()

    def _read(self) -> dict[str, Any]:
        assert self.process.stdout
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"{self.library} with {self.case} ended")
        return {"case": self.case, "library": self.library, **json.loads(line)}

    def close(self) -> None:
        """Ends the process after its present rollout."""
        self.process.communicate()


def measured(case: str, libraries: list[str], pythons: dict[str, str], core: int, rounds: int) -> list[dict[str, Any]]:
    """Returns the rollouts of all libraries; those of round 0 compile."""
    processes = [Process(case, library, pythons[library], core) for library in libraries]
    rows = [{"round": 0, **process.first} for process in processes]
    print(json.dumps(rows), flush=True)
    for i in range(1, rounds + 1):
        rows += [{"round": i, **process.take()} for process in processes]
        print(*(f"{row['library']} {row['processor_seconds']:.2f}" for row in rows[-len(processes) :]), flush=True)
    for process in processes:
        process.close()
    return rows


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the medians by case and library, and those of the ratios of rejeu to each in the same round."""
    results = []
    for case, library in dict.fromkeys((row["case"], row["library"]) for row in rows):
        compiling, *later = [row for row in rows if (row["case"], row["library"]) == (case, library)]
        result = {"case": case, "library": library, "rounds": len(later)}
        for clock in ("processor", "wall"):
            result[f"steps_per_{clock}_second"] = ROLLOUT / median(row[f"{clock}_seconds"] for row in later)
        result["compile_seconds"] = compiling["compile_seconds"]
        base = {row["round"]: row for row in rows if (row["case"], row["library"]) == (case, "rejeu")}
        if library != "rejeu" and base:
            clock = "processor_seconds"
            ratios = [row[clock] / base[row["round"]][clock] for row in later]
            result |= {"rejeu_to_this": median(ratios), "least_ratio": min(ratios), "most_ratio": max(ratios)}
        results.append(result)
    return results


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=[*CASES], choices=[*CASES])
    parser.add_argument("--libraries", nargs="+", default=[*TRAINERS], choices=[*TRAINERS])
    for library in TRAINERS:
        parser.add_argument(f"--{library}-python", default=sys.executable, help=f"Python with {library}")
    parser.add_argument("--core", type=int, default=0, help="which all processes share")
    parser.add_argument("--rounds", type=int, nargs="+", default=[12, 3], help="rollouts of each library, by case")
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child is not None:
        child(*json.loads(arguments.child))
        return
    pythons = {library: getattr(arguments, f"{library}_python") for library in TRAINERS}
    rows: list[dict[str, Any]] = []
    for i, case in enumerate(arguments.cases):
        rounds = arguments.rounds[min(i, len(arguments.rounds) - 1)]
        rows += measured(case, arguments.libraries, pythons, arguments.core, rounds)
    results = summary(rows)
    content = {
        **provenance(dict.fromkeys(pythons.values(), "PATH")),
        "machine": {"platform": platform.platform(), **machine()},
        "versions": {row["library"]: row["versions"] for row in rows},
        "settings": {"n_envs": N_ENVS, "n_steps": N_STEPS, "n_epochs": N_EPOCHS, "n_minibatches": N_MINIBATCHES},
        "results": results,
        "measurements": [{key: value for key, value in row.items() if key != "versions"} for row in rows],
    }
    write(arguments.out, content, "measurements")
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
