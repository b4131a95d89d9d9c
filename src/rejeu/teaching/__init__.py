"""Courses, games played by hand, and the ball."""
