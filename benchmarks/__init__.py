"""What is measured, and what came out of it; see ``scripts/bench`` and the scripts beside this file."""
