"""Processes that run loops, and the pool that keeps them."""
