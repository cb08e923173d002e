"""Access control of the experimenter's pages: logins, cookies and login attempts."""
