"""The doctor: which depth encoding the pictures of a scene confirm, found without trusting depth.

The modules in the order in which a scene passes through them: `hypotheses` (what may be wrong),
`matching` (pixels found in two pictures), `scoring` (how well a hypothesis explains them, and its
scale), `cameras` (each camera beside the others), `diagnosis` (one scene), `verdict` (scenes
together), `worlds` (readings of poses), `doctor` (a whole data set) and `report`.
"""
