"""The web server: endpoints, limits, headers, files."""
