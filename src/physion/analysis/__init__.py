"""Comparison of models with people: tables in, tables out; no trial is opened."""
