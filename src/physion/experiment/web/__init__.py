"""HTTP layer of the server: API endpoints, guards of requests, static files and media."""
