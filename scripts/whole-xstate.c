/* Lets Debian's user-mode-linux 6.1 run on processors with AMX; scripts/with-vcan preloads it there.
 *
 * The user-mode kernel keeps 2,696 bytes of a process's floating-point state. Where AMX makes the state larger, the host
 * takes it back only whole (xstateregs_set, EFAULT else), and the user-mode kernel dies at its first process. Here what it
 * writes back is filled up with zeros: the components that it does not know are not marked in the header, so stay as new.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

static char whole[1 << 16];
static size_t whole_size;

long ptrace(enum __ptrace_request request, ...)
{
    static long (*libc_ptrace)(int, pid_t, void *, void *);
    va_list rest;
    va_start(rest, request);
    pid_t pid = va_arg(rest, pid_t);
    void *address = va_arg(rest, void *), *data = va_arg(rest, void *);
    va_end(rest);

    if (!libc_ptrace)
        libc_ptrace = dlsym(RTLD_NEXT, "ptrace");
    if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE) {
        struct iovec *known = data, filled = {whole, sizeof whole};
        if (!whole_size && libc_ptrace(PTRACE_GETREGSET, pid, address, &filled) == 0) {
            whole_size = filled.iov_len;
            memset(whole, 0, sizeof whole);
        }
        if (known->iov_len < whole_size) {
            memcpy(whole, known->iov_base, known->iov_len);
            filled.iov_len = whole_size;
            return libc_ptrace(request, pid, address, &filled);
        }
    }
    return libc_ptrace(request, pid, address, data);
}
