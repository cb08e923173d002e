"""What sessions consist of: the blocks of several scenarios, and the settings of conditions."""
