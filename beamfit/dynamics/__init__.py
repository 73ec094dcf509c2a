"""Processes in time: responses, state spaces, balances, and what runs say of them."""
