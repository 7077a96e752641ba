"""Small ROS nodes for demonstrations and tests: ``echo`` and ``counter`` serve, ``caller`` calls.

Launch files refer to them as Python modules: ``Node(package="fog_demo", executable="echo")``.
"""
