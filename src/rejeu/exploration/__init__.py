"""How actions are varied while training: noise on actions, and what carries it from step to step."""
