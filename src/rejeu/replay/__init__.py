"""Replay buffers: where experience is kept on the host, and how batches are drawn from it."""
