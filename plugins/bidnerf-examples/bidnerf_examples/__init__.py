"""Examples of parts that bidnerf accepts by name from third parties: a reader, a method, a keypoint detector
and a fault.
"""
