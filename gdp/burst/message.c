/* Burst core, messages: the cipher of a message, the hash that its signature covers, and the buffer of its plaintext.
 *
 * AES-256-GCM and SHA-256 are those of OpenSSL's libcrypto. The nonce of a part is bytes 8 to 20 of its frame, message
 * number and part. The additional data are the header without its hops.
 */
#include "core.h"
#include <openssl/core_names.h>
#include <openssl/crypto.h>
#include <openssl/evp.h>
#include <openssl/params.h>
#include <string.h>

enum {
    KEY = 32,
    DIGEST = 32,
    GROWTH = 4, /* a buffer becomes so many times larger, as far as its message may need it */
};

static EVP_CIPHER *aes_256_gcm;
static EVP_MD *sha_256;
static PyTypeObject *digest_type, *plaintext_type;

typedef struct {
    PyObject_HEAD
    EVP_CIPHER_CTX *context; /* has the message's key */
    int is_sealing;          /* direction of the context: 1 seals, 0 opens, -1 neither yet */
    int is_busy;             /* in a call that has released the interpreter's lock */
    uint8_t key[KEY];
} MessageCipher;

typedef struct {
    PyObject_HEAD
    EVP_MD_CTX *context;
} RunningDigest;

typedef struct {
    PyObject_HEAD
    PyObject *bytes; /* NULL: nothing yet */
    Py_ssize_t used, size, expected;
} Plaintext;

static void put_number(uint8_t *to, uint64_t value, int bytes)
{
    for (int at = bytes - 1; at >= 0; at--, value >>= 8)
        to[at] = (uint8_t)value;
}

static uint32_t number_at(const uint8_t *from)
{
    return (uint32_t)from[0] << 24 | (uint32_t)from[1] << 16 | (uint32_t)from[2] << 8 | from[3];
}

/* ---- the hash that a signature covers ---- */

static PyObject *digest_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    const char *first;
    Py_ssize_t size;
    (void)keywords;
    if (!PyArg_ParseTuple(args, "y#:RunningDigest", &first, &size))
        return NULL;
    RunningDigest *self = allocate(type, 0);
    if (self == NULL)
        return NULL;
    self->context = EVP_MD_CTX_new();
    if (self->context == NULL || !EVP_DigestInit_ex(self->context, sha_256, NULL) ||
        !EVP_DigestUpdate(self->context, first, size)) {
        Py_DECREF(self);
        return failure("hash");
    }
    return (PyObject *)self;
}

static void digest_free(RunningDigest *self)
{
    EVP_MD_CTX_free(self->context);
    free_object((PyObject *)self);
}

static PyObject *digest_update(RunningDigest *self, PyObject *args)
{
    const char *more;
    Py_ssize_t size;
    if (!PyArg_ParseTuple(args, "y#:update", &more, &size))
        return NULL;
    if (!EVP_DigestUpdate(self->context, more, size))
        return failure("hash");
    Py_RETURN_NONE;
}

static PyObject *digest_digest(RunningDigest *self, PyObject *ignored)
{
    uint8_t digest[DIGEST];
    EVP_MD_CTX *copy = EVP_MD_CTX_new();
    int is_made = copy != NULL && EVP_MD_CTX_copy_ex(copy, self->context) && EVP_DigestFinal_ex(copy, digest, NULL);
    (void)ignored;
    EVP_MD_CTX_free(copy);
    return is_made ? PyBytes_FromStringAndSize((const char *)digest, DIGEST) : failure("hash");
}

/* Returns the context of an argument that is a running digest or None, or NULL; sets an exception if it is neither. */
static EVP_MD_CTX *hash_of(PyObject *running)
{
    if (running == Py_None)
        return NULL;
    if (Py_TYPE(running) == digest_type)
        return ((RunningDigest *)running)->context;
    PyErr_SetString(PyExc_TypeError, "a RunningDigest, or None");
    return NULL;
}

/* ---- the buffer of a message's plaintext ---- */

static PyObject *plaintext_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    Py_ssize_t expected;
    (void)keywords;
    if (!PyArg_ParseTuple(args, "n:Plaintext", &expected))
        return NULL;
    Plaintext *self = allocate(type, 0);
    if (self != NULL)
        self->expected = expected;
    return (PyObject *)self;
}

static void plaintext_free(Plaintext *self)
{
    Py_XDECREF(self->bytes);
    free_object((PyObject *)self);
}

/* Returns where the next ``more`` bytes go; NULL and an exception: there is no memory for them. */
static uint8_t *space_for(Plaintext *self, Py_ssize_t more)
{
    Py_ssize_t needed = self->used + more;
    if (self->bytes == NULL || needed > self->size) {
        Py_ssize_t size = needed < self->expected / GROWTH ? needed * GROWTH : self->expected;
        if (size < needed)
            size = 2 * needed;
        PyObject *larger = PyBytes_FromStringAndSize(NULL, size);
        if (larger == NULL)
            return NULL;
        if (self->bytes != NULL)
            memcpy(PyBytes_AsString(larger), PyBytes_AsString(self->bytes), self->used);
        Py_XDECREF(self->bytes);
        self->bytes = larger;
        self->size = size;
    }
    return (uint8_t *)PyBytes_AsString(self->bytes) + self->used;
}

static PyObject *plaintext_append(Plaintext *self, PyObject *args)
{
    const char *more;
    Py_ssize_t size;
    if (!PyArg_ParseTuple(args, "y#:append", &more, &size))
        return NULL;
    uint8_t *to = space_for(self, size);
    if (to == NULL)
        return NULL;
    memcpy(to, more, size);
    self->used += size;
    Py_RETURN_NONE;
}

static PyObject *plaintext_collect(Plaintext *self, PyObject *ignored)
{
    (void)ignored;
    PyObject *whole = self->bytes;
    Py_ssize_t used = self->used;
    self->bytes = NULL;
    self->used = self->size = 0;
    if (whole == NULL || used == 0 || Py_REFCNT(whole) > 1) { /* the latter: another thread writes into it */
        Py_XDECREF(whole);
        return PyBytes_FromStringAndSize("", 0);
    }
    PyBytes_AsString(whole)[used] = 0;
    Py_SET_SIZE((PyVarObject *)whole, used); /* nothing else has seen the object, so it may still become shorter */
    return whole;
}

/* ---- the cipher of a message ---- */

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
    uint8_t additional[HEADER - 1];
    memcpy(additional, frame, HOPS_AT);
    memcpy(additional + HOPS_AT, frame + HOPS_AT + 1, HEADER - HOPS_AT - 1);
    return EVP_CipherInit_ex(self->context, NULL, NULL, NULL, frame + NUMBER_AT, -1) &&
           EVP_CipherUpdate(self->context, NULL, &ignored, additional, sizeof additional);
}

/* Gets or sets the tag of a part; by parameters, because EVP_CIPHER_CTX_ctrl looks up what it means. */
static int get_tag(MessageCipher *self, uint8_t *tag)
{
    OSSL_PARAM wanted[] = {OSSL_PARAM_construct_octet_string(OSSL_CIPHER_PARAM_AEAD_TAG, tag, TAG), OSSL_PARAM_END};
    return EVP_CIPHER_CTX_get_params(self->context, wanted);
}

static int set_tag(MessageCipher *self, const uint8_t *tag)
{
    OSSL_PARAM given[] = {OSSL_PARAM_construct_octet_string(OSSL_CIPHER_PARAM_AEAD_TAG, (void *)tag, TAG), OSSL_PARAM_END};
    return EVP_CIPHER_CTX_set_params(self->context, given);
}

/* Encrypts ``length`` bytes to where the ciphertext of a part continues; returns 0 if OpenSSL fails. */
static int encrypt(MessageCipher *self, uint8_t **body, const uint8_t *plain, Py_ssize_t length)
{
    int written = 0;
    if (length && !EVP_EncryptUpdate(self->context, *body, &written, plain, (int)length))
        return 0;
    *body += length;
    return 1;
}

/* Decrypts a part of ``length`` bytes; returns 0 if its tag is wrong. ``plain`` is then without meaning. */
static int open_part(MessageCipher *self, const uint8_t *frame, int length, uint8_t *plain)
{
    int written = 0, ended = 0;
    const uint8_t *body = frame + BODY_AT;
    return begin_part(self, frame) && (length == 0 || EVP_DecryptUpdate(self->context, plain, &written, body, length)) &&
           set_tag(self, body + length) &&
           EVP_DecryptFinal_ex(self->context, plain + written, &ended);
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
    const uint8_t *head, *prefix, *message; /* a part's plaintext is of the prefix, then of the message */
    Py_ssize_t prefix_size, size;           /* size: of both */
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

static void put_header(const Outgoing *out, uint8_t *frame, uint32_t part)
{
    int is_last = part == out->parts - 1;
    memcpy(frame, out->head, BODY_AT);
    frame[FLAGS_AT] |= is_last ? FLAG_LAST : 0;
    put_number(frame + LENGTH_AT, SALT + plain_bytes(out, part) + TAG + (is_last ? out->signature_bytes : 0), 2);
    put_number(frame + PART_AT, part, 4);
}

/* Writes a sealed part, without a signature; returns 0 if OpenSSL fails. */
static int seal_part(MessageCipher *self, const Outgoing *out, uint8_t *frame, uint32_t part)
{
    Py_ssize_t begin = (Py_ssize_t)part * out->capacity, length = plain_bytes(out, part), of_prefix = 0;
    uint8_t *body = frame + BODY_AT;
    int ended = 0;
    put_header(out, frame, part);
    if (!begin_part(self, frame))
        return 0;
    if (length && begin < out->prefix_size) {
        of_prefix = out->prefix_size - begin < length ? out->prefix_size - begin : length;
        if (!encrypt(self, &body, out->prefix + begin, of_prefix))
            return 0;
    }
    return (length == of_prefix ||
            encrypt(self, &body, out->message + begin + of_prefix - out->prefix_size, length - of_prefix)) &&
           EVP_EncryptFinal_ex(self->context, body, &ended) && get_tag(self, body);
}

static PyObject *cipher_seal(MessageCipher *self, PyObject *args)
{
    Outgoing out;
    const char *head, *prefix, *message;
    Py_ssize_t head_size, first, end;
    PyObject *running;
    if (!PyArg_ParseTuple(args, "y#nny#y#niO:seal", &head, &head_size, &first, &end, &prefix, &out.prefix_size, &message,
                          &out.size, &out.capacity, &out.signature_bytes, &running))
        return NULL;
    if (head_size != BODY_AT || out.capacity < 1 || out.capacity > FRAME_MAX - BODY_AT - TAG || out.signature_bytes < 0)
        return refusal("a header with its salt, and a capacity that frames have");
    out.head = (const uint8_t *)head, out.prefix = (const uint8_t *)prefix, out.message = (const uint8_t *)message;
    out.size += out.prefix_size;
    out.parts = number_at(out.head + PACE_AT) & 0xffffff; /* without the pace */
    if (first < 0 || end < first || end > (Py_ssize_t)out.parts)
        return refusal("parts of the message");
    EVP_MD_CTX *hash = hash_of(running);
    if (PyErr_Occurred())
        return NULL;

    Py_ssize_t count = end - first, at = 0;
    uint8_t **frames = PyMem_Malloc((count + 1) * sizeof *frames);
    PyObject *list = PyList_New(count), *result = NULL;
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
    }
    if (!take(self))
        goto end;
    int is_sealed;
    Py_BEGIN_ALLOW_THREADS;
    is_sealed = set_direction(self, 1);
    for (; is_sealed && at < count; at++) {
        uint32_t part = (uint32_t)(first + at);
        is_sealed = seal_part(self, &out, frames[at], part) &&
                    (hash == NULL || EVP_DigestUpdate(hash, frames[at] + BODY_AT, plain_bytes(&out, part) + TAG));
    }
    Py_END_ALLOW_THREADS;
    self->is_busy = 0;
    if (is_sealed) {
        Py_INCREF(list);
        result = list;
    } else {
        failure("seal");
    }
end:
    PyMem_Free(frames);
    Py_XDECREF(list);
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

static PyObject *cipher_open_run(MessageCipher *self, PyObject *args)
{
    const char *head;
    Py_ssize_t head_size, first, count, length, at, taken = 0;
    PyObject *arrivals, *running, *into;
    if (!PyArg_ParseTuple(args, "y#nnnOnOO:open_run", &head, &head_size, &length, &first, &count, &arrivals, &at,
                          &running, &into))
        return NULL;
    if (head_size != BODY_AT || length < SALT + TAG || length > FRAME_MAX - HEADER || first < 0 || count < 0 || at < 0 ||
        first + count > UINT32_MAX)
        return refusal("a header with its salt, and parts of the message");
    if (Py_TYPE(into) != plaintext_type) {
        PyErr_SetString(PyExc_TypeError, "a Plaintext");
        return NULL;
    }
    EVP_MD_CTX *hash = hash_of(running);
    Frame *frames = PyErr_Occurred() ? NULL : frames_of(arrivals, at, &count);
    if (frames == NULL)
        return NULL;

    Py_ssize_t plain_bytes = length - SALT - TAG;
    Plaintext *buffer = (Plaintext *)into;
    Py_ssize_t begin = buffer->used;
    uint8_t expected[BODY_AT], *to = space_for(buffer, count * plain_bytes);
    PyObject *bytes = buffer->bytes, *result = NULL;
    if (to == NULL || !take(self))
        goto end;
    memcpy(expected, head, BODY_AT);
    put_number(expected + LENGTH_AT, length, 2);
    Py_INCREF(bytes); /* for this call: another thread may replace the buffer meanwhile */
    Py_BEGIN_ALLOW_THREADS;
    int is_open = set_direction(self, 0);
    for (; is_open && taken < count; taken += is_open) {
        const uint8_t *frame = frames[taken].bytes;
        put_number(expected + PART_AT, first + taken, 4);
        is_open = frames[taken].size >= HEADER + length && !memcmp(frame, expected, BODY_AT) &&
                  open_part(self, frame, (int)plain_bytes, to + taken * plain_bytes) &&
                  (hash == NULL || EVP_DigestUpdate(hash, frame + BODY_AT, length - SALT));
    }
    Py_END_ALLOW_THREADS;
    Py_DECREF(bytes);
    self->is_busy = 0;
    if (buffer->bytes == bytes)
        buffer->used = begin + taken * plain_bytes;
    result = PyLong_FromSsize_t(taken);
end:
    release_frames(frames, count);
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
    MessageCipher *self = allocate(type, 0);
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
    EVP_CIPHER_CTX_free(self->context); /* clears the expanded key */
    OPENSSL_cleanse(self->key, KEY);
    free_object((PyObject *)self);
}

/* ---- the types ---- */

static PyMethodDef digest_methods[] = {
    {"update", (PyCFunction)digest_update, METH_VARARGS, "As that of hashlib."},
    {"digest", (PyCFunction)digest_digest, METH_NOARGS, "As that of hashlib."},
    {NULL, NULL, 0, NULL},
};

static PyMethodDef plaintext_methods[] = {
    {"append", (PyCFunction)plaintext_append, METH_VARARGS, "As that of cipher.Plaintext."},
    {"collect", (PyCFunction)plaintext_collect, METH_NOARGS, "As cipher.Plaintext.collect."},
    {NULL, NULL, 0, NULL},
};

static PyMethodDef cipher_methods[] = {
    {"seal", (PyCFunction)cipher_seal, METH_VARARGS, "As cipher.MessageCipher.seal."},
    {"open", (PyCFunction)cipher_open, METH_VARARGS, "As cipher.MessageCipher.open."},
    {"open_run", (PyCFunction)cipher_open_run, METH_VARARGS, "As cipher.MessageCipher.open_run."},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot digest_slots[] = {
    {Py_tp_new, digest_new},
    {Py_tp_dealloc, digest_free},
    {Py_tp_methods, digest_methods},
    {Py_tp_doc, "SHA-256 of hashlib, which a cipher's calls also feed."},
    {0, NULL},
};

static PyType_Slot plaintext_slots[] = {
    {Py_tp_new, plaintext_new},
    {Py_tp_dealloc, plaintext_free},
    {Py_tp_methods, plaintext_methods},
    {Py_tp_doc, "Compiled twin of cipher.Plaintext."},
    {0, NULL},
};

static PyType_Slot cipher_slots[] = {
    {Py_tp_new, cipher_new},
    {Py_tp_dealloc, cipher_free},
    {Py_tp_methods, cipher_methods},
    {Py_tp_doc, "Compiled twin of cipher.MessageCipher."},
    {0, NULL},
};

static PyType_Spec digest_spec = {
    "gdp.burst.core.RunningDigest", sizeof(RunningDigest), 0, Py_TPFLAGS_DEFAULT, digest_slots};
static PyType_Spec plaintext_spec = {
    "gdp.burst.core.Plaintext", sizeof(Plaintext), 0, Py_TPFLAGS_DEFAULT, plaintext_slots};
static PyType_Spec cipher_spec = {
    "gdp.burst.core.MessageCipher", sizeof(MessageCipher), 0, Py_TPFLAGS_DEFAULT, cipher_slots};

int add_messages(PyObject *module)
{
    aes_256_gcm = EVP_CIPHER_fetch(NULL, "AES-256-GCM", NULL);
    sha_256 = EVP_MD_fetch(NULL, "SHA-256", NULL);
    if (aes_256_gcm == NULL || sha_256 == NULL) {
        PyErr_SetString(PyExc_ImportError, "libcrypto lacks AES-256-GCM or SHA-256");
        return 0;
    }
    digest_type = (PyTypeObject *)PyType_FromSpec(&digest_spec);
    plaintext_type = (PyTypeObject *)PyType_FromSpec(&plaintext_spec);
    PyTypeObject *cipher_type = (PyTypeObject *)PyType_FromSpec(&cipher_spec);
    return digest_type != NULL && plaintext_type != NULL && cipher_type != NULL &&
           PyModule_AddType(module, digest_type) == 0 && PyModule_AddType(module, plaintext_type) == 0 &&
           PyModule_AddType(module, cipher_type) == 0;
}
