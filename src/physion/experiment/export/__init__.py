"""The collected data as tables and in the layouts of other conventions."""
