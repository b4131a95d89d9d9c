"""Records the outputs of Stable-Baselines3's vector environments and callbacks for ``tests/sb3/test_golden.py``.

Run it in an environment with stable-baselines3 (2.9.2 was used)::

    python tests/golden/record_vec_env.py

It writes ``vec_env_sb3.npz`` to its own folder. The scripts are in ``vec_env_script.py``, which the test runs too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import vec_env_script as script


def main() -> None:
    """Writes the file."""
    library = "stable_baselines3"
    record = {f"vec.{key}": value for key, value in script.vector_environments(library).items()}
    for name in ("PPO", "DQN"):
        record |= {f"{name}.{key}": value for key, value in script.callbacks(library, name).items()}
    path = Path(__file__).with_name("vec_env_sb3.npz")
    np.savez_compressed(path, **record)
    print(path, path.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
