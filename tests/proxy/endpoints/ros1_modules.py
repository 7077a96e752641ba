"""What a ROS 1 master, its nodes and a proxy's rospy process import, for a zygote that imports it once."""

import importlib
import sys

from proxy.endpoints.ros1.install import rospy_folder

sys.path.insert(0, rospy_folder())  # first, as in the rospy process
for _module in ("rosmaster.main", "std_msgs.msg", "std_srvs.srv", "proxy.endpoints.ros1.node"):
    importlib.import_module(_module)
