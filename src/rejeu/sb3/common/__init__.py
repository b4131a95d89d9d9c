"""Modules shared by the algorithms."""

from typing import Any

from rejeu.sb3.modules import define


class RMSpropTFLike:
    """The name of an optimizer for ``optimizer_class``: RMSprop with epsilon inside of the square root, as rejeu's has it."""

    def __init__(self, *args: object, **kwargs: Any) -> None:
        raise NotImplementedError(
            "RMSpropTFLike is a name for policy_kwargs here; to optimize by hand use optax.rmsprop"
        )


define(f"{__name__}.sb2_compat", {})
define(f"{__name__}.sb2_compat.rmsprop_tf_like", {"RMSpropTFLike": RMSpropTFLike})
define(f"{__name__}.on_policy_algorithm", {}, "OnPolicyAlgorithm")
define(f"{__name__}.off_policy_algorithm", {}, "OffPolicyAlgorithm")
