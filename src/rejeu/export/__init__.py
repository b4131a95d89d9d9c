"""Trained policies as files of other formats, which act as ``predict`` does: ONNX, C, StableHLO.

The deterministic policy is traced as one pure function, from raw observations to actions of the environment, into a
:class:`~rejeu.export.program.TracedProgram`. Each format is a translation of its operations.
"""
