"""Names for :func:`rejeu.tune`: the kinds of ranges, and what it returns."""

from __future__ import annotations

from rejeu.algorithms.search import Choice, Integers, LogUniform, NearOne, Uniform
from rejeu.experiments.search import Final
from rejeu.experiments.study import Outcome
from rejeu.experiments.study_plan import Plan
from rejeu.experiments.tune import Result, tune

__all__ = ["Choice", "Final", "Integers", "LogUniform", "NearOne", "Outcome", "Plan", "Result", "Uniform", "tune"]
