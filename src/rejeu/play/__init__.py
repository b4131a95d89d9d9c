"""Environments played by hand: ``keys.py`` says which action the keys held stand for, ``known.py`` for which environment."""
