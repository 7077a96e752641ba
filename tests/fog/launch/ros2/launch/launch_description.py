"""Description of a launch; visiting it returns its entities."""

from launch.core import LaunchDescriptionEntity


class LaunchDescription(LaunchDescriptionEntity):
    def __init__(self, initial_entities=None, *, deprecated_reason=None):
        self._entities = list(initial_entities or ())

    @property
    def entities(self):
        return self._entities

    def add_action(self, action):
        self._entities.append(action)

    def visit(self, context):
        return self._entities
