"""HTTP layer of the server: API endpoints, request limits, headers, pages and media."""
