"""Controllers, and the simulation that plays them."""

from hno.control.policy import Feedback, Policy, as_policy

__all__ = ["Feedback", "Policy", "as_policy"]
