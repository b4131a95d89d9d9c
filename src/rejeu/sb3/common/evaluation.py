"""Measuring a policy."""

from rejeu.reporting.evaluation import evaluate_policy

__all__ = ["evaluate_policy"]
