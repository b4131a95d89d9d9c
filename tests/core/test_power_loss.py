"""A power cut between any two file operations of a run leaves a checkpoint that is at most one interval old."""

from pathlib import PurePath

import pytest

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.core.errors import CheckpointError
from tests.agents.test_resume import BALL, OFF
from tests.crash_states import Operation, Recorder, crash_states, make
from tests.sharing import shared_learners

EVERY = 10


def recorded(root, agent, keep=1, steps=45):
    """The file operations of a run with a checkpoint every ten steps, ``done`` after each; it trains on one environment."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        recorder = Recorder(monkeypatch, root)
        saver = Checkpoint(root / "runs" / "one", every=EVERY, keep=keep)
        save = saver.save

        def saved(*arguments):
            path = save(*arguments)
            recorder.add("done", root)
            return path

        def note(agent, turn):
            recorder.note = turn.step

        saver.save, recorder.note = saved, 0
        agent.learn(steps, [note, saver])
    return recorder.operations


def outcome(state, folder, kind=rejeu.SAC):
    """How many steps a power cut would cost, or why nothing could be resumed."""
    make(state, folder)
    try:
        agent = kind.resume(folder / "runs" / "one")
    except (CheckpointError, FileNotFoundError) as error:
        return str(error)
    agent.env.close()
    return state.note - agent.num_timesteps


def is_loss(found):
    """Whether an outcome is worse than what is promised."""
    return isinstance(found, str) or found > EVERY


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The operations of a run whose replay buffer comes round, and the files that it left."""
    root = tmp_path_factory.mktemp("recorded")
    with shared_learners():
        operations = recorded(root, rejeu.SAC("MlpPolicy", BALL, **{**OFF, "buffer_size": 25}))
    return operations, {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*.safetensors")}


def outcomes(operations, tmp_path, ignored=(), each=1):
    """Those of the states that a power cut may leave once the first checkpoint was saved."""
    states = [state for state in crash_states(operations, ignored) if state.n_done][::each]
    with shared_learners():
        return [outcome(state, tmp_path / str(i)) for i, state in enumerate(states)]


@pytest.mark.filterwarnings("ignore:.*resuming from the checkpoint before it")
def test_a_power_cut_costs_at_most_one_interval(run, tmp_path):
    """Some of the states; ``trials/reliability.md`` has the result of all, of several kinds of run."""
    found = outcomes(run[0], tmp_path, each=6)
    assert [one for one in found if is_loss(one)] == []
    assert len(found) > 15


def test_all_that_was_written_was_recorded(run):
    *_, last = crash_states(run[0])
    assert {name: content for name, content in last.files.items() if name.endswith(".safetensors")} == run[1]


@pytest.mark.filterwarnings("ignore:.*resuming from the checkpoint before it")
@pytest.mark.parametrize("ignored", ["sync", "sync folder"])
def test_without_bringing_files_or_names_to_disk_checkpoints_would_be_lost(run, ignored, tmp_path):
    assert any(map(is_loss, outcomes(run[0], tmp_path, (ignored,), each=12)))


def test_the_states_of_a_file_that_is_renamed_before_it_is_brought_to_disk():
    path, new = PurePath("a.tmp"), PurePath("a")
    operations = [Operation("create", path), Operation("write", path, b"1234"), Operation("rename", path, new)]
    left = {tuple(sorted(state.files.items())) for state in crash_states(operations)}
    contents = (b"", b"12", bytes(4), b"1234")
    assert left == {(), *(((name, content),) for name in ("a", "a.tmp") for content in contents)}
