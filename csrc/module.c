// An empty Python module: importing torch_surfcap._C loads this shared library, whose static initialisers
// register the operators with torch. It keeps to Python's limited API, so one build serves every Python
// from 3.10 on.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_C", "Loads the compiled operators of torch_surfcap into torch.ops.torch_surfcap.", 0, NULL,
};

PyMODINIT_FUNC PyInit__C(void) { return PyModule_Create(&module); }
