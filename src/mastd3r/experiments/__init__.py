"""Suites of runs: what to run, running what is missing, and the tables made of it."""
