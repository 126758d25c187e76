"""Closed loop: how safe and how costly a policy is."""
