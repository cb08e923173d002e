"""Trials on disk: files of a trial, index of a dataset, reading and writing of both."""
