"""What is launched; visiting it gives its entities."""


class LaunchDescription:
    def __init__(self, initial_entities=None):
        self.entities = list(initial_entities or ())

    def visit(self, context):
        return self.entities

    def get_asyncio_future(self):
        return None
