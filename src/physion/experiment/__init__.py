"""The online experiment with people: study folder, web server, database and data export."""
