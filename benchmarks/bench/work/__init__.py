"""The measurements, one module each. ``python -m benchmarks.bench.work.NAME JSON`` prints one JSON object.

Each measurement runs in a new process, with the Python interpreter of its library. Modules therefore import rejeu or
another library only after they have read which one to measure.
"""
