/* Burst core: the compiled twins of this package. They seal and open the parts of one message in one call, with the
 * interpreter's lock released, and make received frames of the slots of a pool.
 *
 * The twins in Python are normative: both return the same values for the same arguments. No cipher is implemented here.
 * AES-256-GCM, its tag check included, is that of OpenSSL's libcrypto (EVP, version 3.0 or later). Layout of a frame
 * (frame/spec.md):
 *
 *     0 version  1 kind  2 flags  3 hops left  4 epoch (2)  6 payload length (2)  8 number (8)  16 part (4)  20 parts (4)
 *     24 incarnation (8)  32 destination (32)  64 source (32)  96 salt (8)  104 ciphertext, tag (16), signature
 *
 * The nonce is bytes 8 to 20: message number and part. The additional data are the header without its hops.
 *
 *     cc -O2 -fPIC -shared -I<Python's headers> core.c -o core.abi3.so -lcrypto
 */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030a0000
#include <Python.h>
#include <limits.h>
#include <openssl/crypto.h>
#include <openssl/evp.h>
#include <stdint.h>
#include <string.h>

enum {
    INTERFACE = 3, /* raised with each change of what Python calls */
    FLAGS_AT = 2,
    HOPS_AT = 3,
    LENGTH_AT = 6,
    NUMBER_AT = 8,
    PART_AT = 16,
    PARTS_AT = 20,
    DESTINATION_AT = 32,
    DESTINATION = 32,
    ENDS = 64, /* destination and source */
    HEADER = 96,
    SALT = 8,
    BODY_AT = HEADER + SALT,
    TAG = 16,
    ETHER = 14,
    MAC = 6,
    KEY = 32,
    FLAG_LAST = 0x01,
    VERSION = 1,
    CONTROL_FROM = 0x80,
    HOPS_MASK = 0x7f,
    SECOND_PATH = 0x80,
    FRAME_MAX = 65535,
};

static EVP_CIPHER *aes_256_gcm;
static PyTypeObject *received_frame; /* ReceivedFrame, a named tuple */

typedef struct {
    PyObject_HEAD
    EVP_CIPHER_CTX *context; /* has the message's key */
    int is_sealing;          /* direction of the context: 1 seals, 0 opens, -1 neither yet */
    int is_busy;             /* in a call that has released the interpreter's lock */
    uint8_t key[KEY];
} MessageCipher;

static void put_number(uint8_t *to, uint64_t value, int bytes)
{
    for (int at = bytes - 1; at >= 0; at--, value >>= 8)
        to[at] = (uint8_t)value;
}

static uint32_t number_at(const uint8_t *from)
{
    return (uint32_t)from[0] << 24 | (uint32_t)from[1] << 16 | (uint32_t)from[2] << 8 | from[3];
}

/* Gives the context key and direction, once for all parts of a message in one direction. */
static int set_direction(MessageCipher *self, int is_sealing)
{
    if (self->is_sealing == is_sealing)
        return 1;
    if (!EVP_CipherInit_ex(self->context, aes_256_gcm, NULL, self->key, NULL, is_sealing))
        return 0;
    self->is_sealing = is_sealing;
    return 1;
}

/* Begins a part: nonce and additional data, both from its header. */
static int begin_part(MessageCipher *self, const uint8_t *frame)
{
    int ignored;
    return EVP_CipherInit_ex(self->context, NULL, NULL, NULL, frame + NUMBER_AT, -1) &&
           EVP_CipherUpdate(self->context, NULL, &ignored, frame, HOPS_AT) &&
           EVP_CipherUpdate(self->context, NULL, &ignored, frame + HOPS_AT + 1, HEADER - HOPS_AT - 1);
}

/* Encrypts a part behind its header and salt; returns 0 if OpenSSL fails. */
static int seal_part(MessageCipher *self, uint8_t *frame, const uint8_t *plain, int length)
{
    int written = 0, ended = 0;
    uint8_t *body = frame + BODY_AT;
    return begin_part(self, frame) && (length == 0 || EVP_EncryptUpdate(self->context, body, &written, plain, length)) &&
           EVP_EncryptFinal_ex(self->context, body + written, &ended) &&
           EVP_CIPHER_CTX_ctrl(self->context, EVP_CTRL_GCM_GET_TAG, TAG, body + length);
}

/* Decrypts a part of ``length`` bytes; returns 0 if its tag is wrong. ``plain`` is then without meaning. */
static int open_part(MessageCipher *self, const uint8_t *frame, int length, uint8_t *plain)
{
    int written = 0, ended = 0;
    const uint8_t *body = frame + BODY_AT;
    return begin_part(self, frame) && (length == 0 || EVP_DecryptUpdate(self->context, plain, &written, body, length)) &&
           EVP_CIPHER_CTX_ctrl(self->context, EVP_CTRL_GCM_SET_TAG, TAG, (void *)(body + length)) &&
           EVP_DecryptFinal_ex(self->context, plain + written, &ended);
}

static PyObject *failure(const char *what)
{
    PyErr_Format(PyExc_RuntimeError, "OpenSSL does not %s", what);
    return NULL;
}

static PyObject *refusal(const char *why)
{
    PyErr_SetString(PyExc_ValueError, why);
    return NULL;
}

/* Marks a cipher as taken by this call; another thread's call fails meanwhile, because a context serves one. */
static int take(MessageCipher *self)
{
    if (self->is_busy) {
        PyErr_SetString(PyExc_RuntimeError, "this cipher is in use by another thread");
        return 0;
    }
    return self->is_busy = 1;
}

typedef struct {
    const uint8_t *message;
    Py_ssize_t size;
    Py_ssize_t capacity;
    uint32_t parts;
    int signature_bytes;
} Outgoing;

/* Returns how many bytes of the message a part carries: none, where only the signature is left. */
static Py_ssize_t plain_bytes(const Outgoing *out, uint32_t part)
{
    Py_ssize_t left = out->size - (Py_ssize_t)part * out->capacity;
    return left < 0 ? 0 : left < out->capacity ? left : out->capacity;
}

static void put_header(const Outgoing *out, uint8_t *frame, const uint8_t *head, uint32_t part)
{
    int is_last = part == out->parts - 1;
    memcpy(frame, head, BODY_AT);
    frame[FLAGS_AT] |= is_last ? FLAG_LAST : 0;
    put_number(frame + LENGTH_AT, SALT + plain_bytes(out, part) + TAG + (is_last ? out->signature_bytes : 0), 2);
    put_number(frame + PART_AT, part, 4);
}

static PyObject *cipher_seal(MessageCipher *self, PyObject *args)
{
    Outgoing out;
    const char *head, *message;
    Py_ssize_t head_size, first, end;
    if (!PyArg_ParseTuple(args, "y#nny#ni:seal", &head, &head_size, &first, &end, &message, &out.size, &out.capacity,
                          &out.signature_bytes))
        return NULL;
    if (head_size != BODY_AT || out.capacity < 1 || out.capacity > FRAME_MAX - BODY_AT - TAG || out.signature_bytes < 0)
        return refusal("a header with its salt, and a capacity that frames have");
    out.message = (const uint8_t *)message;
    out.parts = number_at((const uint8_t *)head + PARTS_AT);
    if (first < 0 || end < first || end > (Py_ssize_t)out.parts)
        return refusal("parts of the message");

    Py_ssize_t count = end - first, payload_bytes = 0, at = 0;
    uint8_t **frames = PyMem_Malloc((count + 1) * sizeof *frames);
    PyObject *list = PyList_New(count), *payloads = NULL, *result = NULL;
    if (frames == NULL || list == NULL) {
        PyErr_NoMemory();
        goto end;
    }
    for (Py_ssize_t each = 0; each < count; each++) {
        Py_ssize_t length = plain_bytes(&out, (uint32_t)(first + each)) + TAG;
        PyObject *frame = PyBytes_FromStringAndSize(NULL, BODY_AT + length);
        if (frame == NULL)
            goto end;
        PyList_SetItem(list, each, frame);
        frames[each] = (uint8_t *)PyBytes_AsString(frame);
        payload_bytes += out.signature_bytes ? length : 0;
    }
    payloads = PyBytes_FromStringAndSize(NULL, payload_bytes);
    if (payloads == NULL || !take(self))
        goto end;
    uint8_t *payload = (uint8_t *)PyBytes_AsString(payloads);
    int is_sealed;
    Py_BEGIN_ALLOW_THREADS;
    is_sealed = set_direction(self, 1);
    for (; is_sealed && at < count; at++) {
        uint32_t part = (uint32_t)(first + at);
        Py_ssize_t length = plain_bytes(&out, part);
        put_header(&out, frames[at], (const uint8_t *)head, part);
        is_sealed = seal_part(self, frames[at], length ? out.message + (Py_ssize_t)part * out.capacity : NULL, (int)length);
        if (out.signature_bytes) {
            memcpy(payload, frames[at] + BODY_AT, length + TAG);
            payload += length + TAG;
        }
    }
    Py_END_ALLOW_THREADS;
    self->is_busy = 0;
    result = is_sealed ? PyTuple_Pack(2, list, payloads) : failure("seal");
end:
    PyMem_Free(frames);
    Py_XDECREF(list);
    Py_XDECREF(payloads);
    return result;
}

static PyObject *cipher_open(MessageCipher *self, PyObject *args)
{
    const char *frame;
    Py_ssize_t size, end;
    if (!PyArg_ParseTuple(args, "y#n:open", &frame, &size, &end))
        return NULL;
    if (end < BODY_AT + TAG || end > FRAME_MAX)
        return refusal("the end of a sealed part");
    if (size < end)
        Py_RETURN_NONE;
    PyObject *plain = PyBytes_FromStringAndSize(NULL, end - BODY_AT - TAG), *payload = NULL, *result = NULL;
    if (plain == NULL || !take(self))
        goto end;
    int is_open = set_direction(self, 0) &&
                  open_part(self, (const uint8_t *)frame, (int)(end - BODY_AT - TAG), (uint8_t *)PyBytes_AsString(plain));
    self->is_busy = 0;
    if (!is_open) {
        Py_INCREF(Py_None);
        result = Py_None;
    } else if ((payload = PyBytes_FromStringAndSize(frame + BODY_AT, end - BODY_AT)) != NULL) {
        result = PyTuple_Pack(2, plain, payload);
    }
end:
    Py_XDECREF(plain);
    Py_XDECREF(payload);
    return result;
}

/* Collects frames as new references, from tuples whose third item is the frame; returns how many. */
static Py_ssize_t collect(PyObject *arrivals, Py_ssize_t at, Py_ssize_t count, PyObject **frames)
{
    Py_ssize_t found = 0;
    for (; found < count; found++) {
        PyObject *arrival = PySequence_GetItem(arrivals, at + found);
        PyObject *frame = arrival != NULL && PyTuple_Check(arrival) ? PyTuple_GetItem(arrival, 2) : NULL;
        if (frame == NULL || !PyBytes_Check(frame)) {
            Py_XDECREF(arrival);
            if (!PyErr_Occurred())
                PyErr_SetString(PyExc_TypeError, "received frames are tuples with their bytes in the third place");
            break;
        }
        Py_INCREF(frame);
        Py_DECREF(arrival);
        frames[found] = frame;
    }
    return found;
}

static PyObject *cipher_open_run(MessageCipher *self, PyObject *args)
{
    const char *head;
    Py_ssize_t head_size, first, count, length, at;
    PyObject *arrivals;
    int wants_payloads;
    if (!PyArg_ParseTuple(args, "y#nnnOnp:open_run", &head, &head_size, &length, &first, &count, &arrivals, &at,
                          &wants_payloads))
        return NULL;
    if (head_size != BODY_AT || length < SALT + TAG || length > FRAME_MAX - HEADER || first < 0 || count < 0 || at < 0 ||
        first + count > UINT32_MAX)
        return refusal("a header with its salt, and parts of the message");
    Py_ssize_t arrived = PySequence_Size(arrivals);
    if (arrived < 0)
        return NULL;
    count = count < arrived - at ? count : arrived > at ? arrived - at : 0;

    Py_ssize_t payload_bytes = length - SALT, plain_bytes = payload_bytes - TAG, found = 0, taken = 0;
    PyObject **frames = PyMem_Malloc((count + 1) * sizeof *frames);
    const uint8_t **begins = PyMem_Malloc((count + 1) * sizeof *begins);
    PyObject *plain = PyBytes_FromStringAndSize(NULL, count * plain_bytes);
    PyObject *payloads = PyBytes_FromStringAndSize(NULL, wants_payloads ? count * payload_bytes : 0), *result = NULL;
    if (frames == NULL || begins == NULL || plain == NULL || payloads == NULL) {
        PyErr_NoMemory();
        goto end;
    }
    found = collect(arrivals, at, count, frames);
    if (found < count || !take(self))
        goto end;
    for (Py_ssize_t each = 0; each < count; each++)
        begins[each] = PyBytes_Size(frames[each]) < HEADER + length ? NULL : (const uint8_t *)PyBytes_AsString(frames[each]);
    uint8_t *to = (uint8_t *)PyBytes_AsString(plain), *payload = (uint8_t *)PyBytes_AsString(payloads), expected[BODY_AT];
    memcpy(expected, head, BODY_AT);
    put_number(expected + LENGTH_AT, length, 2);
    Py_BEGIN_ALLOW_THREADS;
    int is_open = set_direction(self, 0);
    for (; is_open && taken < count; taken += is_open) {
        const uint8_t *frame = begins[taken];
        put_number(expected + PART_AT, first + taken, 4);
        is_open = frame != NULL && !memcmp(frame, expected, BODY_AT) &&
                  open_part(self, frame, (int)plain_bytes, to + taken * plain_bytes);
        if (is_open && wants_payloads)
            memcpy(payload + taken * payload_bytes, frame + BODY_AT, payload_bytes);
    }
    Py_END_ALLOW_THREADS;
    self->is_busy = 0;
    result = taken == count ? Py_BuildValue("nOO", taken, plain, payloads)
                            : Py_BuildValue("ny#y#", taken, to, taken * plain_bytes, payload,
                                            wants_payloads ? taken * payload_bytes : 0);
end:
    while (found > 0)
        Py_DECREF(frames[--found]);
    PyMem_Free(frames);
    PyMem_Free((void *)begins);
    Py_XDECREF(plain);
    Py_XDECREF(payloads);
    return result;
}

static PyObject *cipher_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    const char *key;
    Py_ssize_t size;
    (void)keywords;
    if (!PyArg_ParseTuple(args, "y#:MessageCipher", &key, &size))
        return NULL;
    if (size != KEY)
        return refusal("a key has 32 bytes");
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    MessageCipher *self = (MessageCipher *)allocate(type, 0);
    if (self == NULL)
        return NULL;
    memcpy(self->key, key, KEY);
    self->is_sealing = -1;
    self->context = EVP_CIPHER_CTX_new();
    if (self->context == NULL) {
        Py_DECREF(self);
        return failure("make a context");
    }
    return (PyObject *)self;
}

static void cipher_free(MessageCipher *self)
{
    PyTypeObject *type = Py_TYPE(self);
    EVP_CIPHER_CTX_free(self->context); /* clears the expanded key */
    OPENSSL_cleanse(self->key, KEY);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

/* Puts a new reference into a new tuple; returns 0 if there is none. */
static int put_item(PyObject *tuple, Py_ssize_t at, PyObject *item)
{
    return item != NULL && PyTuple_SetItem(tuple, at, item) == 0;
}

static PyObject *received(PyObject *module, PyObject *args)
{
    PyObject *pool, *sizes, *port, *waited_s, *mac = NULL;
    Py_ssize_t slot_bytes;
    (void)module;
    if (!PyArg_ParseTuple(args, "YnO!OO:received", &pool, &slot_bytes, &PyList_Type, &sizes, &port, &waited_s))
        return NULL;
    Py_ssize_t count = PyList_Size(sizes), held = PyByteArray_Size(pool);
    if (slot_bytes < ETHER || count > held / slot_bytes)
        return refusal("as many slots as the pool has");
    allocfunc allocate = (allocfunc)PyType_GetSlot(received_frame, Py_tp_alloc);
    PyObject *list = PyList_New(count);
    for (Py_ssize_t each = 0; list != NULL && each < count; each++) {
        const char *slot = PyByteArray_AsString(pool) + each * slot_bytes;
        Py_ssize_t size = PyNumber_AsSsize_t(PyList_GetItem(sizes, each), NULL);
        if (size < 0 || size > slot_bytes - ETHER) {
            if (!PyErr_Occurred())
                refusal("frames that fit into their slots");
            break;
        }
        if (mac == NULL || memcmp(PyBytes_AsString(mac), slot + MAC, MAC)) {
            Py_XDECREF(mac);
            mac = PyBytes_FromStringAndSize(slot + MAC, MAC);
        }
        PyObject *arrival = allocate(received_frame, 4);
        if (arrival == NULL || PyList_SetItem(list, each, arrival) < 0)
            break;
        Py_INCREF(port);
        Py_XINCREF(mac);
        Py_INCREF(waited_s);
        if (!put_item(arrival, 0, port) || !put_item(arrival, 1, mac) ||
            !put_item(arrival, 2, PyBytes_FromStringAndSize(slot + ETHER, size)) || !put_item(arrival, 3, waited_s))
            break;
    }
    Py_XDECREF(mac);
    if (PyErr_Occurred())
        Py_CLEAR(list);
    return list;
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

static PyObject *runs(PyObject *module, PyObject *args)
{
    PyObject *pool, *sizes;
    Py_ssize_t slot_bytes, first = 0, largest = 0;
    uint8_t key[ENDS] = {0}, run_key[ENDS] = {0};
    int has_key = 0, had_key = 0;
    (void)module;
    if (!PyArg_ParseTuple(args, "YnO!:runs", &pool, &slot_bytes, &PyList_Type, &sizes))
        return NULL;
    Py_ssize_t count = PyList_Size(sizes);
    if (slot_bytes < ETHER + HEADER || count > PyByteArray_Size(pool) / slot_bytes)
        return refusal("as many slots as the pool has");
    PyObject *found = PyList_New(0);
    for (Py_ssize_t slot = 0; found != NULL && slot <= count; slot++) {
        Py_ssize_t size = slot < count ? PyNumber_AsSsize_t(PyList_GetItem(sizes, slot), NULL) : 0;
        if (slot < count)
            has_key = key_of((const uint8_t *)PyByteArray_AsString(pool) + slot * slot_bytes + ETHER, size, key);
        if (slot && (slot == count || !has_key || !had_key || memcmp(key, run_key, ENDS))) {
            PyObject *run = Py_BuildValue("nny#n", first, slot - first, run_key, (Py_ssize_t)(had_key ? ENDS : 0), largest);
            if (run == NULL || PyList_Append(found, run) < 0)
                Py_CLEAR(found);
            Py_XDECREF(run);
            first = slot;
        }
        largest = first == slot || size > largest ? size : largest;
        had_key = has_key;
        memcpy(run_key, key, ENDS);
    }
    if (PyErr_Occurred())
        Py_CLEAR(found);
    return found;
}

static PyMethodDef functions[] = {
    {"runs", runs, METH_VARARGS, "As slots.runs."},
    {"received", received, METH_VARARGS, "As slots.received."},
    {NULL, NULL, 0, NULL},
};

static PyMethodDef methods[] = {
    {"seal", (PyCFunction)cipher_seal, METH_VARARGS, "As cipher.MessageCipher.seal."},
    {"open", (PyCFunction)cipher_open, METH_VARARGS, "As cipher.MessageCipher.open."},
    {"open_run", (PyCFunction)cipher_open_run, METH_VARARGS, "As cipher.MessageCipher.open_run."},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot slots[] = {
    {Py_tp_new, cipher_new},
    {Py_tp_dealloc, cipher_free},
    {Py_tp_methods, methods},
    {Py_tp_doc, "Compiled twin of cipher.MessageCipher."},
    {0, NULL},
};

static PyType_Spec spec = {
    .name = "gdp.burst.core.MessageCipher",
    .basicsize = sizeof(MessageCipher),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = slots,
};

static PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "gdp.burst.core",
    .m_doc = "Burst core: the compiled twins of gdp.burst.",
    .m_size = -1,
    .m_methods = functions,
};

PyMODINIT_FUNC PyInit_core(void)
{
    aes_256_gcm = EVP_CIPHER_fetch(NULL, "AES-256-GCM", NULL);
    if (aes_256_gcm == NULL) {
        PyErr_SetString(PyExc_ImportError, "libcrypto has no AES-256-GCM");
        return NULL;
    }
    PyObject *sansio = PyImport_ImportModule("gdp.sansio"), *type = PyType_FromSpec(&spec), *made = PyModule_Create(&module);
    received_frame = sansio == NULL ? NULL : (PyTypeObject *)PyObject_GetAttrString(sansio, "ReceivedFrame");
    Py_XDECREF(sansio);
    if (received_frame == NULL || type == NULL || made == NULL ||
        PyModule_AddIntConstant(made, "INTERFACE", INTERFACE) < 0 ||
        PyModule_AddStringConstant(made, "LIBRARY", OpenSSL_version(OPENSSL_VERSION)) < 0 ||
        PyModule_AddObject(made, "MessageCipher", type) < 0) {
        Py_XDECREF(made);
        Py_XDECREF(type);
        return NULL;
    }
    return made;
}
