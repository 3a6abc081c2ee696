"""What is wrong with a capture: its images, lights and ground truth against each other. Nothing here changes data."""
