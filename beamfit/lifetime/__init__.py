"""Stored beams: the decay law, the loss mechanisms, and what records of current say of them."""
