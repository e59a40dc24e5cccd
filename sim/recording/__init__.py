"""Runs on disk: one writer and one reader."""
