"""Four cars at a crossing of two roads, for hno."""
