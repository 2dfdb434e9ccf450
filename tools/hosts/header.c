/* The header is C11 that any compiler takes with all warnings on. */
#include <splatvk.h>

_Static_assert(sizeof(SvkStatus) == 4 && sizeof(SvkCamera) == 144, "the layout that src/capi/types.rs has");

int main(void) { return svk_abi_version() == SVK_ABI_VERSION ? 0 : 1; }
