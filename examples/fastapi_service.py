"""A web service that acts with an exported policy, without JAX, for observations that are one Box.

For a Dict, let ``action`` take a ``dict[str, list]``, and make one array of each key, of the dtype of its space.

MODEL=runs/NAME/policy.npz uvicorn --app-dir examples fastapi_service:app
curl -X POST localhost:8000/action -H "Content-Type: application/json" -d "[0.0, 0.1, 0.0, -0.1]"
"""

import os
from typing import Any

import numpy as np
from fastapi import FastAPI, HTTPException

import rejeu

policy = rejeu.load_policy(os.environ["MODEL"])
if policy.observation_space.shape is None:
    raise TypeError(f"this service takes observations of one Box, got {policy.observation_space}")
app = FastAPI(title="rejeu policy")


@app.get("/spaces")
def spaces() -> dict[str, str]:
    """Returns what the policy takes and returns."""
    return {"observation": str(policy.observation_space), "action": str(policy.action_space)}


@app.post("/action")
def action(observation: list[float]) -> Any:
    """Returns the action for an observation."""
    obs = np.array(observation, policy.observation_space.dtype)
    if obs.shape != policy.observation_space.shape or not np.isfinite(obs).all():
        raise HTTPException(422, f"expected finite numbers of {policy.observation_space}")
    return policy.predict(obs)[0].tolist()
