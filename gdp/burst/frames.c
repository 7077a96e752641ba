/* Burst core, frames: received into slots by one recvmmsg, read there without a copy, and sent by one sendmmsg.
 *
 * A slot holds a frame from its Ethernet header on.
 */
#include "core.h"
#include <errno.h>
#include <linux/sockios.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>

enum {
    AT_ONCE = 128, /* frames of one system call */
    FRAME = 2,     /* place of the bytes in a ReceivedFrame */
    SEAL_END = 9,  /* bytes from the end of a frame: the seal that a sample adds, and the byte that makes it one */
    SAMPLE_BITS = 0x3f,
};

static const double WAITED_MOST_S = 10.0; /* beyond that the system clock was set */
static PyTypeObject *received_frame;      /* ReceivedFrame, a named tuple */
static PyTypeObject *arrivals_type;

/* Puts a new reference into a new tuple; returns 0 if there is none. */
static int put_item(PyObject *tuple, Py_ssize_t at, PyObject *item)
{
    return item != NULL && PyTuple_SetItem(tuple, at, item) == 0;
}

static PyObject *same(PyObject *object)
{
    Py_XINCREF(object);
    return object;
}

/* Returns a ReceivedFrame of a slot. ``mac``: of the frame before; the same sender's is used again. */
static PyObject *read_slot(const char *slot, Py_ssize_t size, PyObject *port, PyObject *waited_s, PyObject **mac)
{
    if (*mac == NULL || memcmp(PyBytes_AsString(*mac), slot + MAC, MAC)) {
        Py_XDECREF(*mac);
        *mac = PyBytes_FromStringAndSize(slot + MAC, MAC);
    }
    PyObject *arrival = allocate(received_frame, 4);
    if (arrival != NULL && put_item(arrival, 0, same(port)) && put_item(arrival, 1, same(*mac)) &&
        put_item(arrival, FRAME, PyBytes_FromStringAndSize(slot + ETHER, size)) && put_item(arrival, 3, same(waited_s)))
        return arrival;
    Py_XDECREF(arrival);
    return NULL;
}

/* ---- frames that one system call received, in the pool of slots where the kernel wrote them ---- */

typedef struct {
    PyObject_HEAD
    PyObject *pool, *port, *waited_s, *mac;
    Py_ssize_t slot_bytes, count;
    int sizes[AT_ONCE]; /* after the Ethernet headers */
} Arrivals;

static const char *slot_of(const Arrivals *self, Py_ssize_t at)
{
    return PyByteArray_AsString(self->pool) + at * self->slot_bytes;
}

static void arrivals_free(Arrivals *self)
{
    Py_XDECREF(self->pool);
    Py_XDECREF(self->port);
    Py_XDECREF(self->waited_s);
    Py_XDECREF(self->mac);
    free_object((PyObject *)self);
}

static Py_ssize_t arrivals_length(Arrivals *self)
{
    return self->count;
}

static PyObject *arrivals_item(Arrivals *self, Py_ssize_t at)
{
    if (at < 0 || at >= self->count) {
        PyErr_SetString(PyExc_IndexError, "fewer frames arrived");
        return NULL;
    }
    return read_slot(slot_of(self, at), self->sizes[at], self->port, self->waited_s, &self->mac);
}

static PyObject *arrivals_subscript(Arrivals *self, PyObject *key)
{
    Py_ssize_t begin, end, step;
    if (!PySlice_Check(key)) {
        Py_ssize_t at = PyNumber_AsSsize_t(key, PyExc_IndexError);
        return at == -1 && PyErr_Occurred() ? NULL : arrivals_item(self, at < 0 ? at + self->count : at);
    }
    if (PySlice_Unpack(key, &begin, &end, &step) < 0)
        return NULL;
    Py_ssize_t count = PySlice_AdjustIndices(self->count, &begin, &end, step);
    PyObject *list = PyList_New(count);
    for (Py_ssize_t each = 0; list != NULL && each < count; each++) {
        PyObject *arrival = arrivals_item(self, begin + each * step);
        if (arrival == NULL || PyList_SetItem(list, each, arrival) < 0)
            Py_CLEAR(list);
    }
    return list;
}

Frame *frames_of(PyObject *arrivals, Py_ssize_t at, Py_ssize_t *count)
{
    Py_ssize_t arrived = PyObject_Size(arrivals), found = 0;
    if (arrived < 0)
        return NULL;
    Py_ssize_t wanted = *count < arrived - at ? *count : arrived > at ? arrived - at : 0;
    Frame *frames = PyMem_Malloc((wanted + 1) * sizeof *frames);
    if (frames == NULL) {
        PyErr_NoMemory();
        return NULL;
    }
    for (; found < wanted; found++) {
        if (Py_TYPE(arrivals) == arrivals_type) {
            const Arrivals *from = (const Arrivals *)arrivals;
            frames[found] = (Frame){(const uint8_t *)slot_of(from, at + found) + ETHER, from->sizes[at + found], NULL};
            continue;
        }
        PyObject *arrival = PySequence_GetItem(arrivals, at + found), *frame = arrival;
        if (arrival != NULL && PyTuple_Check(arrival))
            frame = PyTuple_GetItem(arrival, FRAME);
        if (frame == NULL || !PyBytes_Check(frame)) {
            Py_XDECREF(arrival);
            if (!PyErr_Occurred())
                PyErr_SetString(PyExc_TypeError, "frames are bytes, and received ones tuples with these in the third place");
            release_frames(frames, found);
            return NULL;
        }
        frames[found] = (Frame){(const uint8_t *)PyBytes_AsString(frame), PyBytes_Size(frame), same(frame)};
        Py_DECREF(arrival);
    }
    *count = wanted;
    return frames;
}

void release_frames(Frame *frames, Py_ssize_t count)
{
    while (count > 0)
        Py_XDECREF(frames[--count].held);
    PyMem_Free(frames);
}

/* ---- system calls ---- */

typedef struct {
    PyObject_HEAD
    PyObject *pool; /* a bytearray; another one once arrivals that are still in use have it */
    Py_ssize_t slot_bytes, slots;
} Receiver;

static PyObject *receiver_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    Py_ssize_t slot_bytes, slots;
    (void)keywords;
    if (!PyArg_ParseTuple(args, "nn:Receiver", &slot_bytes, &slots))
        return NULL;
    if (slot_bytes < ETHER || slot_bytes > ETHER + FRAME_MAX || slots < 1 || slots > AT_ONCE)
        return refusal("slots for frames, of one system call");
    Receiver *self = allocate(type, 0);
    if (self == NULL)
        return NULL;
    self->slot_bytes = slot_bytes;
    self->slots = slots;
    return (PyObject *)self;
}

static void receiver_free(Receiver *self)
{
    Py_XDECREF(self->pool);
    free_object((PyObject *)self);
}

/* Returns for how many seconds the frame that was read last had waited, as sockets.waited_s. */
static double waited_s(int source)
{
    struct timespec came, now;
    if (ioctl(source, SIOCGSTAMPNS_OLD, &came) < 0)
        return 0.0;
    clock_gettime(CLOCK_REALTIME, &now);
    double since_s = (double)(now.tv_sec - came.tv_sec) + (double)(now.tv_nsec - came.tv_nsec) * 1e-9;
    return since_s >= 0.0 && since_s < WAITED_MOST_S ? since_s : 0.0;
}

/* Writes the key of a frame in the forwarding table; returns 0 if it is for the node itself, or not in order. */
static int key_of(const uint8_t *frame, Py_ssize_t size, uint8_t *key)
{
    uint8_t hops = frame[HOPS_AT];
    if (frame[0] != VERSION || frame[1] >= CONTROL_FROM || (hops & HOPS_MASK) <= 1 ||
        HEADER + (frame[LENGTH_AT] << 8 | frame[LENGTH_AT + 1]) > size)
        return 0;
    memcpy(key, frame + DESTINATION_AT, ENDS);
    if (hops & SECOND_PATH)
        key[DESTINATION - 1] ^= 1;
    return 1;
}

/* Fills the slots with the frames that wait at a socket, and returns how many came; -1 and an exception: no memory.
 * No frames, or the device went down: the link monitor reports it. */
static int fill_slots(Receiver *self, int source, int *sizes, double *since_s)
{
    struct mmsghdr messages[AT_ONCE];
    struct iovec vectors[AT_ONCE];
    int got;
    if (self->pool == NULL || Py_REFCNT(self->pool) > 1) {
        Py_XDECREF(self->pool);
        self->pool = PyByteArray_FromStringAndSize(NULL, self->slots * self->slot_bytes);
    }
    if (self->pool == NULL)
        return -1;
    memset(messages, 0, self->slots * sizeof *messages);
    for (Py_ssize_t slot = 0; slot < self->slots; slot++) {
        vectors[slot] = (struct iovec){PyByteArray_AsString(self->pool) + slot * self->slot_bytes, self->slot_bytes};
        messages[slot].msg_hdr.msg_iov = vectors + slot;
        messages[slot].msg_hdr.msg_iovlen = 1;
    }
    PyObject *held = same(self->pool);
    Py_BEGIN_ALLOW_THREADS;
    got = recvmmsg(source, messages, (unsigned)self->slots, MSG_DONTWAIT, NULL);
    if (got > 0 && since_s != NULL)
        *since_s = waited_s(source);
    Py_END_ALLOW_THREADS;
    Py_DECREF(held);
    for (int slot = 0; slot < got; slot++)
        sizes[slot] = messages[slot].msg_len > ETHER ? (int)messages[slot].msg_len - ETHER : 0;
    return got > 0 ? got : 0;
}

static PyObject *receiver_receive(Receiver *self, PyObject *args)
{
    int source;
    double since_s = 0.0;
    PyObject *port;
    if (!PyArg_ParseTuple(args, "iO:receive", &source, &port))
        return NULL;
    Arrivals *arrivals = allocate(arrivals_type, 0);
    int got = arrivals == NULL ? -1 : fill_slots(self, source, arrivals->sizes, &since_s);
    if (got < 0) {
        Py_XDECREF(arrivals);
        return NULL;
    }
    arrivals->pool = same(self->pool);
    arrivals->slot_bytes = self->slot_bytes;
    arrivals->count = got;
    arrivals->port = same(port);
    arrivals->waited_s = PyFloat_FromDouble(since_s);
    return (PyObject *)arrivals;
}

/* Calls ``failed`` with an errno and the frames that are left; returns how many of these are lost, or -1. */
static Py_ssize_t ask_failed(PyObject *failed, int error, Py_ssize_t left)
{
    PyObject *answer = PyObject_CallFunction(failed, "in", error, left);
    Py_ssize_t lost = answer == NULL ? -1 : PyNumber_AsSsize_t(answer, PyExc_OverflowError);
    Py_XDECREF(answer);
    return lost > 0 || PyErr_Occurred() ? lost : left;
}

/* Sends ``count`` slots from ``slot`` on to one neighbour; returns how many left, or -1 and an exception. */
static Py_ssize_t send_slots(const Receiver *self, char *slot, const int *sizes, Py_ssize_t count, PyObject *hop,
                             PyObject *failed)
{
    struct mmsghdr messages[AT_ONCE];
    struct iovec vectors[2 * AT_ONCE];
    char head[ETHER];
    const char *macs;
    Py_ssize_t macs_size, sent = 0;
    int sink, error;
    if (!PyArg_ParseTuple(hop, "iy#:hop", &sink, &macs, &macs_size))
        return -1;
    if (macs_size != 2 * MAC) {
        refusal("two addresses");
        return -1;
    }
    memcpy(head, macs, 2 * MAC);
    memcpy(head + 2 * MAC, slot + 2 * MAC, ETHER - 2 * MAC);
    memset(messages, 0, count * sizeof *messages);
    for (Py_ssize_t each = 0; each < count; each++) {
        vectors[2 * each] = (struct iovec){head, ETHER};
        vectors[2 * each + 1] = (struct iovec){slot + each * self->slot_bytes + ETHER, (size_t)sizes[each]};
        messages[each].msg_hdr.msg_iov = vectors + 2 * each;
        messages[each].msg_hdr.msg_iovlen = 2;
    }
    for (Py_ssize_t at = 0, step; at < count; at += step) {
        Py_BEGIN_ALLOW_THREADS;
        step = sendmmsg(sink, messages + at, (unsigned)(count - at), MSG_DONTWAIT);
        error = errno;
        Py_END_ALLOW_THREADS;
        if (step > 0)
            sent += step;
        else if ((step = ask_failed(failed, error, count - at)) < 0)
            return -1;
    }
    return sent;
}

/* Sends a run to each hop that ``route`` returns, or gives its frames to ``other``; returns as ``send_slots``. */
static Py_ssize_t forward_run(const Receiver *self, char *slot, const int *sizes, Py_ssize_t count, const uint8_t *key,
                              PyObject *const callbacks[3])
{
    Py_ssize_t sent = 0, left = 0, largest = 0;
    PyObject *hops = NULL;
    for (Py_ssize_t each = 0; each < count; each++)
        largest = sizes[each] > largest ? sizes[each] : largest;
    if (key != NULL) {
        PyObject *found = PyObject_CallFunction(callbacks[0], "y#n", key, (Py_ssize_t)ENDS, largest);
        hops = found == NULL ? NULL : PySequence_Tuple(found);
        Py_XDECREF(found);
        if (hops == NULL)
            return -1;
    }
    Py_ssize_t hop_count = hops == NULL ? 0 : PyTuple_Size(hops);
    for (Py_ssize_t each = 0; hop_count == 0 && left >= 0 && each < count; each++) {
        const char *frame = slot + each * self->slot_bytes;
        PyObject *done = PyObject_CallFunction(callbacks[1], "y#", frame, (Py_ssize_t)(ETHER + sizes[each]));
        left = done == NULL ? -1 : 0;
        Py_XDECREF(done);
    }
    for (Py_ssize_t each = 0; hop_count > 0 && each < count; each++)
        slot[each * self->slot_bytes + ETHER + HOPS_AT]--;
    for (Py_ssize_t hop = 0; left >= 0 && hop < hop_count; hop++) {
        left = send_slots(self, slot, sizes, count, PyTuple_GetItem(hops, hop), callbacks[2]);
        sent += left;
    }
    Py_XDECREF(hops);
    return left < 0 ? -1 : sent;
}

static PyObject *receiver_forward(Receiver *self, PyObject *args)
{
    int source, got, sizes[AT_ONCE];
    PyObject *callbacks[3];
    uint8_t key[ENDS] = {0}, run_key[ENDS] = {0};
    Py_ssize_t first = 0, sent = 0, left = 0;
    int has_key = 0, had_key = 0;
    if (!PyArg_ParseTuple(args, "iOOO:forward", &source, callbacks, callbacks + 1, callbacks + 2))
        return NULL;
    if (self->slot_bytes < ETHER + HEADER)
        return refusal("slots for a header");
    if ((got = fill_slots(self, source, sizes, NULL)) < 0)
        return NULL;
    PyObject *pool = same(self->pool);
    char *begin = PyByteArray_AsString(pool);
    for (Py_ssize_t slot = 0; slot <= got && left >= 0; slot++) {
        if (slot < got)
            has_key = key_of((const uint8_t *)begin + slot * self->slot_bytes + ETHER, sizes[slot], key);
        if (slot && (slot == got || !has_key || !had_key || memcmp(key, run_key, ENDS))) {
            left = forward_run(self, begin + first * self->slot_bytes, sizes + first, slot - first,
                               had_key ? run_key : NULL, callbacks);
            sent += left;
            first = slot;
        }
        had_key = has_key;
        memcpy(run_key, key, ENDS);
    }
    Py_DECREF(pool);
    return left < 0 ? NULL : Py_BuildValue("in", got, sent);
}

static PyObject *send_frames(PyObject *module, PyObject *args)
{
    int sink, sent, error;
    Py_ssize_t at, count = AT_ONCE, head_size;
    const char *head;
    PyObject *list;
    (void)module;
    if (!PyArg_ParseTuple(args, "iOny#:send", &sink, &list, &at, &head, &head_size))
        return NULL;
    if (head_size != ETHER || at < 0)
        return refusal("an Ethernet header, and frames");
    Frame *frames = frames_of(list, at, &count);
    if (frames == NULL)
        return NULL;
    struct mmsghdr messages[AT_ONCE];
    struct iovec vectors[2 * AT_ONCE];
    memset(messages, 0, count * sizeof *messages);
    for (Py_ssize_t each = 0; each < count; each++) {
        vectors[2 * each] = (struct iovec){(void *)head, ETHER};
        vectors[2 * each + 1] = (struct iovec){(void *)frames[each].bytes, (size_t)frames[each].size};
        messages[each].msg_hdr.msg_iov = vectors + 2 * each;
        messages[each].msg_hdr.msg_iovlen = 2;
    }
    Py_BEGIN_ALLOW_THREADS;
    sent = sendmmsg(sink, messages, (unsigned)count, MSG_DONTWAIT);
    error = errno;
    Py_END_ALLOW_THREADS;
    release_frames(frames, count);
    return PyLong_FromLong(sent >= 0 ? sent : -error);
}

/* ---- frames in the slots of a pool ---- */

static PyObject *received(PyObject *module, PyObject *args)
{
    PyObject *pool, *sizes, *port, *waited, *mac = NULL;
    Py_ssize_t slot_bytes;
    (void)module;
    if (!PyArg_ParseTuple(args, "YnO!OO:received", &pool, &slot_bytes, &PyList_Type, &sizes, &port, &waited))
        return NULL;
    Py_ssize_t count = PyList_Size(sizes), held = PyByteArray_Size(pool);
    if (slot_bytes < ETHER || count > held / slot_bytes)
        return refusal("as many slots as the pool has");
    PyObject *list = PyList_New(count);
    for (Py_ssize_t each = 0; list != NULL && each < count; each++) {
        Py_ssize_t size = PyNumber_AsSsize_t(PyList_GetItem(sizes, each), NULL);
        PyObject *arrival = NULL;
        if (size >= 0 && size <= slot_bytes - ETHER)
            arrival = read_slot(PyByteArray_AsString(pool) + each * slot_bytes, size, port, waited, &mac);
        else if (!PyErr_Occurred())
            refusal("frames that fit into their slots");
        if (arrival == NULL || PyList_SetItem(list, each, arrival) < 0)
            Py_CLEAR(list);
    }
    Py_XDECREF(mac);
    return list;
}

/* ---- samples ---- */

/* Returns whether a frame is a sample, and its seal. */
static int sample_of(const Frame *frame, uint64_t *seal)
{
    if (frame->size < SEAL_END || frame->bytes[frame->size - 1] & SAMPLE_BITS)
        return 0;
    *seal = 0;
    for (Py_ssize_t at = frame->size - SEAL_END; at < frame->size - 1; at++)
        *seal = *seal << 8 | frame->bytes[at];
    return 1;
}

static PyObject *samples(PyObject *module, PyObject *args)
{
    PyObject *arrivals, *found;
    Py_ssize_t at, count;
    uint64_t seal;
    (void)module;
    if (!PyArg_ParseTuple(args, "Onn:samples", &arrivals, &at, &count))
        return NULL;
    if (at < 0 || count < 0)
        return refusal("frames that are there");
    Frame *frames = frames_of(arrivals, at, &count);
    if (frames == NULL)
        return NULL;
    found = PyList_New(0);
    for (Py_ssize_t each = 0; found != NULL && each < count; each++) {
        if (!sample_of(frames + each, &seal))
            continue;
        PyObject *sample = Py_BuildValue("nK", each, (unsigned long long)seal);
        if (sample == NULL || PyList_Append(found, sample) < 0)
            Py_CLEAR(found);
        Py_XDECREF(sample);
    }
    release_frames(frames, count);
    return found;
}

/* ---- types and functions ---- */

static PyMethodDef functions[] = {
    {"received", received, METH_VARARGS, "As slots.received."},
    {"samples", samples, METH_VARARGS, "As slots.samples."},
    {"send", send_frames, METH_VARARGS, "Send frames of a list from a place on; return how many, or minus the errno."},
    {NULL, NULL, 0, NULL},
};

static PyMethodDef receiver_methods[] = {
    {"receive", (PyCFunction)receiver_receive, METH_VARARGS, "Return the frames that wait at a socket, as of a port."},
    {"forward", (PyCFunction)receiver_forward, METH_VARARGS,
     "Forward the frames that wait at a socket, by route, other and failed; return how many came, and how many left."},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot receiver_slots[] = {
    {Py_tp_new, receiver_new},
    {Py_tp_dealloc, receiver_free},
    {Py_tp_methods, receiver_methods},
    {Py_tp_doc, "Slots for the frames of one system call."},
    {0, NULL},
};

static PyType_Slot arrivals_slots[] = {
    {Py_tp_dealloc, arrivals_free},
    {Py_sq_length, arrivals_length},
    {Py_sq_item, arrivals_item},
    {Py_mp_length, arrivals_length},
    {Py_mp_subscript, arrivals_subscript},
    {Py_tp_doc, "Sequence of received frames, each of which is made when it is read."},
    {0, NULL},
};

static PyType_Spec receiver_spec = {
    "gdp.burst.core.Receiver", sizeof(Receiver), 0, Py_TPFLAGS_DEFAULT, receiver_slots};
static PyType_Spec arrivals_spec = {
    "gdp.burst.core.Arrivals", sizeof(Arrivals), 0, Py_TPFLAGS_DEFAULT, arrivals_slots};

int add_frames(PyObject *module)
{
    PyObject *sansio = PyImport_ImportModule("gdp.sansio");
    received_frame = sansio == NULL ? NULL : (PyTypeObject *)PyObject_GetAttrString(sansio, "ReceivedFrame");
    Py_XDECREF(sansio);
    PyTypeObject *receiver_type = (PyTypeObject *)PyType_FromSpec(&receiver_spec);
    arrivals_type = (PyTypeObject *)PyType_FromSpec(&arrivals_spec);
    return received_frame != NULL && receiver_type != NULL && arrivals_type != NULL &&
           PyModule_AddType(module, receiver_type) == 0 && PyModule_AddFunctions(module, functions) == 0;
}
