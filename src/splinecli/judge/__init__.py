"""Find faults in a capture by comparing its images, lights and ground truth. Nothing is changed."""
