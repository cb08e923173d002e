"""Messages between browser and server, and the reasons for a refusal."""
