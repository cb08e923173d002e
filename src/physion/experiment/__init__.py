"""The experiment with people: a study folder, a web server, a store that loses nothing, exports."""
