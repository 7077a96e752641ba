"""Small real ROS nodes, for demonstrations and tests: ``echo`` serves, ``caller`` asks.

They are found as Python modules: ``Node(package="fog_demo", executable="echo")``.
"""
