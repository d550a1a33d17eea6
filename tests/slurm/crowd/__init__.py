"""A pipeline for a cluster: one GPU for each video, then one training over several nodes.

clips -> device -> train
"""

PIPELINE = ("crowd.device:device", "crowd.train:train")
