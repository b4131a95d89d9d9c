"""How actions are varied while training: noise on actions or parameters, and what carries it from step to step."""
