"""Measuring a policy."""

from rejeu.evaluation import evaluate_policy

__all__ = ["evaluate_policy"]
