"""Benchmarks and their results. Run ``scripts/bench`` or the scripts in this folder."""
