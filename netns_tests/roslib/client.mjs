// What the examples of roslib promise, one function a promise: node client.mjs URL prints a line for each.

import { Action, Param, Ros, Service, Topic } from "roslib";

const url = process.argv[2];
const PATIENCE_MS = 8_000;
const STRING = "std_msgs/String";

const equal = (found, wanted) => {
  if (JSON.stringify(found) !== JSON.stringify(wanted)) {
    throw new Error(`${JSON.stringify(found)} is not ${JSON.stringify(wanted)}`);
  }
};

const asked = (ask) => new Promise((resolve, reject) => ask(resolve, (error) => reject(new Error(String(error)))));

// Publish until the subscription hears; return what it heard first.
const heard = async (ros, listener, publisher, message) => {
  let timer;
  const found = await new Promise((resolve) => {
    listener.subscribe(resolve);
    timer = setInterval(() => publisher.publish(message), 100);
  });
  clearInterval(timer);
  listener.unsubscribe();
  publisher.unadvertise();
  return found;
};

const chatter = (ros, name = "/chatter", compression = "none") =>
  new Topic({ ros, name, messageType: STRING, compression });

const image = (ros, compression) =>
  new Topic({ ros, name: "/image", messageType: "sensor_msgs/CompressedImage", compression });

const fibonacci = (ros) =>
  new Action({ ros, name: "/fibonacci", actionType: "example_interfaces/action/Fibonacci" });

const promises = {
  async topics_are_listed(ros) {
    const { topics, types } = await asked((...ends) => ros.getTopics(...ends));
    equal(types[topics.indexOf("/chatter")], "std_msgs/msg/String");
  },
  async topics_are_listed_with_their_definitions(ros) {
    const { topics, typedefs_full_text } = await asked((...ends) => ros.getTopicsAndRawTypes(...ends));
    equal(typedefs_full_text[topics.indexOf("/chatter")].trim(), "string data");
  },
  async the_type_of_a_topic_is_known(ros) {
    equal(await asked((...ends) => ros.getTopicType("/chatter", ...ends)), "std_msgs/msg/String");
  },
  async a_topic_hears_another_of_the_same_client(ros) {
    equal(await heard(ros, chatter(ros), chatter(ros), { data: "hello" }), { data: "hello" });
  },
  async a_topic_hears_another_client(ros) {
    const other = await connected();
    equal(await heard(ros, chatter(ros), chatter(other), { data: "other" }), { data: "other" });
    other.close();
  },
  async a_relative_name_is_the_same_topic(ros) {
    equal(await heard(ros, chatter(ros, "chatter"), chatter(ros), { data: "relative" }), { data: "relative" });
  },
  async an_unsubscribed_topic_hears_nothing(ros) {
    const [listener, publisher] = [chatter(ros), chatter(ros)];
    await heard(ros, listener, publisher, { data: "first" });
    let count = 0;
    ros.on("/chatter", () => (count += 1));
    publisher.publish({ data: "second" });
    await asked((...ends) => ros.getTopics(...ends)); // answered behind it
    ros.removeAllListeners("/chatter");
    equal(count, 0);
  },
  async a_message_may_come_as_png(ros) {
    equal(await heard(ros, chatter(ros, "/chatter", "png"), chatter(ros), { data: "é" }), { data: "é" });
  },
  async a_message_may_come_as_cbor(ros) {
    const found = await heard(ros, image(ros, "cbor"), image(ros), { format: "raw", data: "AQID" });
    equal([found.format, [...found.data]], ["raw", [1, 2, 3]]);
  },
  async a_message_may_come_as_ros_wrote_it(ros) {
    const found = await heard(ros, chatter(ros, "/chatter", "cbor-raw"), chatter(ros), { data: "hi" });
    equal([...found.bytes], [0, 1, 0, 0, 3, 0, 0, 0, 0x68, 0x69, 0]);
  },
  async action_servers_are_listed(ros) {
    equal(await asked((...ends) => ros.getActionServers(...ends)), ["/fibonacci"]);
  },
  async a_goal_has_feedback_and_a_result(ros) {
    const feedback = [];
    const result = await asked((resolve, reject) =>
      fibonacci(ros).sendGoal({ order: 4 }, resolve, (each) => feedback.push(each.sequence.length), reject),
    );
    equal([result.sequence, feedback], [[0, 1, 1, 2, 3], [3, 4, 5]]);
  },
  async a_goal_is_cancelled(ros) {
    const action = fibonacci(ros);
    let goal;
    const end = await new Promise((resolve) => {
      goal = action.sendGoal({ order: 30 }, () => resolve("succeeded"), () => action.cancelGoal(goal), resolve);
    });
    equal(end.includes("Action was canceled"), true);
  },
  async a_service_is_called(ros) {
    const service = new Service({ ros, name: "/switch", serviceType: "std_srvs/SetBool" });
    const response = await asked((...ends) => service.callService({ data: true }, ...ends));
    equal(response, { success: true, message: "done" });
    equal(await asked((...ends) => ros.getServiceType("/switch", ...ends)), "std_srvs/srv/SetBool");
  },
  async a_client_serves_another(ros) {
    const service = new Service({ ros, name: "/test_service", serviceType: "std_srvs/Trigger" });
    service.advertise((request, response) => (response.success = true));
    const client = new Service({ ros, name: "/test_service", serviceType: "std_srvs/Trigger" });
    equal((await asked((...ends) => client.callService({}, ...ends))).success, true);
  },
  async a_parameter_is_had_as_it_was_set(ros) {
    const param = new Param({ ros, name: "/test:foo" });
    await asked((...ends) => param.set("foo", ...ends));
    equal(await asked((...ends) => param.get(...ends)), "foo");
  },
  async nodes_are_listed(ros) {
    await asked((...ends) => ros.getNodes(...ends));
  },
};

const connected = async () => {
  const ros = new Ros({});
  await ros.connect(url);
  if (!ros.isConnected) {
    await new Promise((resolve, reject) => ros.on("connection", resolve).on("error", reject));
  }
  return ros;
};

for (const [name, test] of Object.entries(promises)) {
  const ros = await connected();
  const late = new Promise((_, reject) => setTimeout(() => reject(new Error("too late")), PATIENCE_MS).unref());
  await Promise.race([test(ros), late]).then(
    () => console.log(`PASSED ${name}`),
    (error) => console.log(`FAILED ${name} ${error.message}`),
  );
  ros.close();
}
process.exit(0);
