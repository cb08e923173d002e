"""Protocol between browser and server: message types and refusal codes."""
