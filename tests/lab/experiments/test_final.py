"""The final comparison of a study, without Optuna. The rest is in ``test_study``."""

from types import SimpleNamespace

import numpy as np

from rejeu.lab.experiments import final
from rejeu.logs.tables import Table


def test_what_is_compared_at_the_end_is_the_last_evaluation_and_neither_the_first_nor_the_best():
    table = Table({"step": np.arange(3.0), "mean_return": np.array([1.0, 5.0, 3.0])})
    assert final.last_values([SimpleNamespace(evaluations=table)] * 2, "mean_return").tolist() == [3, 3]
