/* Burst core: layout of a frame (frame/spec.md), and what its source files share.
 *
 *     0 version  1 kind  2 flags  3 hops left  4 epoch (2)  6 payload length (2)  8 number (8)  16 part (4)  20 pace
 *     21 parts (3)  24 incarnation (8)  32 destination (32)  64 source (32)  96 salt (8)  104 ciphertext, tag (16), signature
 */
#pragma once
#define _GNU_SOURCE /* recvmmsg, sendmmsg */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030a0000
#include <Python.h>
#include <stdint.h>

enum {
    FLAGS_AT = 2,
    HOPS_AT = 3,
    LENGTH_AT = 6,
    NUMBER_AT = 8,
    PART_AT = 16,
    PACE_AT = 20,
    DESTINATION_AT = 32,
    DESTINATION = 32,
    ENDS = 64, /* destination and source */
    HEADER = 96,
    SALT = 8,
    BODY_AT = HEADER + SALT,
    TAG = 16,
    ETHER = 14,
    MAC = 6,
    FLAG_LAST = 0x01,
    VERSION = 1,
    CONTROL_FROM = 0x80,
    HOPS_MASK = 0x7f,
    SECOND_PATH = 0x80,
    FRAME_MAX = 65535,
};

/* A frame from its header on. Its bytes stay while ``held`` or the arrivals that it came with do. */
typedef struct {
    const uint8_t *bytes;
    Py_ssize_t size;
    PyObject *held; /* NULL: the arrivals hold it */
} Frame;

/* Returns the frames of ``arrivals[at:]``, at most ``count``, which is set to how many these are; NULL: an error. */
Frame *frames_of(PyObject *arrivals, Py_ssize_t at, Py_ssize_t *count);
void release_frames(Frame *frames, Py_ssize_t count);

PyObject *refusal(const char *why); /* a ValueError */
PyObject *failure(const char *what); /* of OpenSSL */

void *allocate(PyTypeObject *type, Py_ssize_t items); /* a new object */
void free_object(PyObject *self);                     /* what a deallocator ends with */

/* Add their types and functions to the module; return 0 and an exception if that fails. */
int add_messages(PyObject *module);
int add_frames(PyObject *module);
