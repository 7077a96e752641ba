/* Burst core: the compiled twins of this package. They receive, open, seal and send many frames in one call, with the
 * interpreter's lock released. An opened part goes straight from the slot that the kernel filled into its message.
 *
 * The twins in Python are normative: both return the same values for the same arguments. No cipher is implemented here;
 * message.c calls OpenSSL's libcrypto (EVP, version 3.0 or later).
 */
#include "core.h"
#include <openssl/crypto.h>

enum { INTERFACE = 6 }; /* raised with each change of what Python calls */

PyObject *refusal(const char *why)
{
    PyErr_SetString(PyExc_ValueError, why);
    return NULL;
}

PyObject *failure(const char *what)
{
    PyErr_Format(PyExc_RuntimeError, "OpenSSL does not %s", what);
    return NULL;
}

void *allocate(PyTypeObject *type, Py_ssize_t items)
{
    return ((allocfunc)PyType_GetSlot(type, Py_tp_alloc))(type, items);
}

void free_object(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

static PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .m_name = "gdp.burst.core",
    .m_doc = "Burst core: the compiled twins of gdp.burst.",
    .m_size = -1,
};

PyMODINIT_FUNC PyInit_core(void)
{
    PyObject *module = PyModule_Create(&definition);
    if (module != NULL && PyModule_AddIntConstant(module, "INTERFACE", INTERFACE) == 0 &&
        PyModule_AddStringConstant(module, "LIBRARY", OpenSSL_version(OPENSSL_VERSION)) == 0 && add_messages(module) &&
        add_frames(module))
        return module;
    Py_XDECREF(module);
    return NULL;
}
