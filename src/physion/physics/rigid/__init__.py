"""Rigid bodies: contacts, the contact solver, sleep."""
