"""``rejeu.load_policy``: policies that act with NumPy."""

from __future__ import annotations

from pathlib import Path

from rejeu.core.errors import CheckpointError
from rejeu.core.validation import as_path
from rejeu.export import numpy_policy


def load_policy(path: str | Path) -> numpy_policy.NumpyPolicy:
    """Returns the deterministic policy of an exported file or of a model, which acts with NumPy alone.

    A ``.npz`` file, as :meth:`rejeu.SAC.export` writes it, is read without JAX. A model is loaded with JAX, and its policy is
    then as in such a file. No code from the file is run.

    Args:
        path: of a ``.npz`` file, a run folder or a model file; see :func:`rejeu.load`.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if the file is damaged, or a model where JAX is not installed.
        ValueError: if the policy of a model cannot be exported; the message says which part.

    >>> import rejeu
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", seed=0)
    >>> path = agent.export("pendulum.npz").path
    >>> action, _ = rejeu.load_policy(path).predict(agent.observation_space.sample())
    >>> action.shape
    (1,)
    """
    if as_path(path).suffix == ".npz":
        return numpy_policy.read(Path(path))
    try:
        from rejeu.agents import exporting, load
    except ModuleNotFoundError as error:
        raise CheckpointError(
            f"{path} is a model, and {error.name} is not installed; export it where JAX is: rejeu export {path} --to npz"
        ) from None
    return exporting.numpy_policy(load(path), str(path))
