"""Generation of datasets: plan trials, choose scenes, make and write trials, verify a dataset."""
