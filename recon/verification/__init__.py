"""Verification: what speaks for and against a registration, before anything is published."""
