"""What is measured, a module each: ``python -m benchmarks.bench.work.NAME JSON`` prints one JSON object.

Each runs in a fresh process, with the interpreter of the library that it is of, so no module here imports rejeu or a peer
before it knows which.
"""
