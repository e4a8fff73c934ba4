// The kernels for what every processor of the architecture runs. Standard headers come first: code of theirs must stay
// fit for every processor.
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <new>
#include <type_traits>
#include <vector>

#define SURFCAP_ISA baseline
#define SURFCAP_ISA_NAME "baseline"
#include "kernels_isa.h"
