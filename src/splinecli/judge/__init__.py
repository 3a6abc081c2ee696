"""Find faults of a capture by comparing its images, lights and ground truth. Nothing here changes
data.
"""
