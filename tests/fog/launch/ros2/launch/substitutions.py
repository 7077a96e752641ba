"""Values that are known when a description is launched."""


class LaunchConfiguration:
    def __init__(self, variable_name, *, default=None):
        self.variable_name = variable_name
        self.default = default

    def perform(self, context):
        return context.launch_configurations.get(self.variable_name, self.default)


class LocalSubstitution:
    def __init__(self, expression):
        self.expression = expression

    def perform(self, context):
        name, _, key = self.expression.partition("['")
        return getattr(context.locals, name)[key.rstrip("']")]
