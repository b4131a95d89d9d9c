"""``rejeu clone``: an agent that acts as in recorded episodes, in a run folder."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import gymnasium as gym

from rejeu import demonstrations
from rejeu.agents import Agent
from rejeu.callbacks import Checkpoint
from rejeu.callbacks.base import stateful
from rejeu.core.interrupt import Interrupt
from rejeu.core.types import Action, JsonObject, Observation
from rejeu.demonstrations import Demonstrations
from rejeu.envs.registry import register
from rejeu.lab.cli.commands import Clone
from rejeu.lab.cli.models import agent_of
from rejeu.lab.reporting.report import write_report
from rejeu.lab.runs.arguments import Train
from rejeu.lab.runs.begin import begin
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.environment import Environment, from_arguments, from_run
from rejeu.lab.runs.output import Stopwatch, echo
from rejeu.lab.runs.session import Session
from rejeu.logs.formatting import counted

OF_TRAIN = ("hyperparameters", "evaluate_episodes", "device", "seed", "out", "no_report", "no_video")
"""Options that are those of ``rejeu train``."""


def run_clone(arguments: Clone) -> tuple[int, JsonObject]:
    """Clones and evaluates; the exit status is that of ``rejeu train``."""
    stopwatch = Stopwatch()
    shown = demonstrations.read(arguments.dataset)
    environment = environment_of(shown, arguments)
    options = {name: getattr(arguments, name) for name in OF_TRAIN}
    options |= {name: getattr(environment.run, name) for name in ("env_kwargs", "wrappers", "imports")}
    task = Train(env=environment.run.typed, algorithm=arguments.algo, **options)
    with ExitStack() as stack:
        session, stop = begin(task, stack, write_report), stack.enter_context(Interrupt())
        expert = None if arguments.expert is None else expert_of(arguments.expert, arguments, environment)
        demonstrations.check(session.agent, shown)
        if arguments.critic_updates:
            demonstrations.keeping_policy(session.agent)  # which raises before anything is trained
        session = session.in_new_folder(arguments.out)
        folder, seed = session.folder, session.config.seed
        echo(f"environment   {environment}")
        echo(f"algorithm     {session.config.algorithm}, seed {seed}")
        echo(f"shown         {shown}")
        echo(f"run folder    {folder.path}")
        with session.training(stop) as learning:
            if expert is None and not arguments.by_hand:
                rate = arguments.learning_rate
                demonstrations.clone(session.agent, shown, arguments.updates, learning_rate=rate, seed=seed)
            else:
                learn_from_expert(session, expert, shown, arguments, seed)
            if arguments.critic_updates:
                demonstrations.learn_offline(session.agent, shown, arguments.critic_updates, keep_policy=True)
            session.agent.call.callbacks = stateful(learning.callbacks)
        status, result = session.finish(learning, stop, stopwatch)
        checkpoint = Checkpoint(folder.checkpoints)
        checkpoint.before_training(session.agent)
        checkpoint.after_training(session.agent, None)
    recorded = {"episodes": len(shown.episodes), "steps": shown.n_steps, "mean_return": shown.mean_return}
    if learning.evaluate.best is not None:
        evaluation = learning.evaluate.best.evaluation
        echo(f"clone         return {evaluation.mean_return:,.2f}; the demonstrations have {shown.mean_return:,.2f}")
    return status, {**result, "demonstrations": recorded}


def learn_from_expert(
    session: Session, expert: Agent | None, shown: Demonstrations, arguments: Clone, seed: int
) -> None:
    """Trains the agent by DAgger, and prints how good it is after each round; without an expert a person takes over."""

    def say(i: int, labeled: Demonstrations) -> None:
        evaluation = session.agent.evaluate(session.config.evaluate_episodes, env=session.evaluation_env, seed=seed)
        echo(f"round {i:>2}      {counted(labeled.n_steps, 'labeled step')}, return {evaluation.mean_return:,.2f}")

    with ExitStack() as stack:
        if expert is None:
            from rejeu.teaching.play.assist import Expert

            env = stack.enter_context(closing(session.environment.rendering()))
            label: Callable[[Observation], Action] = stack.enter_context(closing(Expert(env, fps=arguments.fps)))
        else:
            env = stack.enter_context(closing(session.environment.make()))
            label = lambda obs: expert.predict(obs, deterministic=True)[0]  # noqa: E731
        demonstrations.dagger(
            session.agent,
            label,
            env,
            shown,
            takes_over=expert is None,
            rounds=arguments.rounds,
            steps=arguments.round_steps,
            updates=arguments.updates,
            learning_rate=arguments.learning_rate,
            seed=seed,
            after_round=say,
        )


def expert_of(run: Path, arguments: Clone, environment: Environment) -> Agent:
    """Returns the agent that labels.

    Raises:
        ValueError: if it was trained on another environment, or has a memory.
    """
    agent = agent_of("--expert", run, arguments.best_or_last, environment, arguments.device)
    if agent.learner.algorithm.recall is not None:
        raise ValueError(
            f"--expert {run}: {agent.name} has a memory, and labels single steps; use one without a memory"
        )
    return agent


def environment_of(shown: Demonstrations, arguments: Clone) -> Environment:
    """Returns the environment that the command line names, else that of the dataset.

    Raises:
        ValueError: if neither says which.
    """
    if arguments.env is not None:
        return from_arguments(arguments.env, arguments)
    spec = shown.spec
    if spec is None or spec.additional_wrappers:
        raise ValueError(f"{arguments.dataset} does not say how to make its environment; name it: --env ENV")
    registered = gym.registry[spec.id].kwargs if register(spec.id) and spec.id in gym.registry else {}
    changed = {key: value for key, value in spec.kwargs.items() if key not in registered or registered[key] != value}
    return from_run(RunConfig(env=spec.id, env_kwargs=changed), arguments.dataset, arguments)
