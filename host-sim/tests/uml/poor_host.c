/* Preloaded by `selftest`: what linux.uml meets on machines where it does not start.

   UML_POOR_HOST=xstate: the buffer for floating point and vector registers is eight bytes shorter than
   what the machine's kernel wants, as UML's is on a processor with AMX. It is that kernel which says
   EFAULT. What is lost, protection keys as a rule, no process in UML uses.
   UML_POOR_HOST=ptrace: ptrace is forbidden. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <errno.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

static long (*next_ptrace)(enum __ptrace_request, ...);
static const char *poor;

__attribute__((constructor)) static void find_next(void)
{
    next_ptrace = (long (*)(enum __ptrace_request, ...))dlsym(RTLD_NEXT, "ptrace");
    poor = getenv("UML_POOR_HOST");
}

long ptrace(enum __ptrace_request request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    pid_t pid = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *), *data = va_arg(arguments, void *);
    va_end(arguments);

    if (poor && strcmp(poor, "ptrace") == 0) {
        errno = EPERM;
        return -1;
    }
    if (poor && strcmp(poor, "xstate") == 0 && (unsigned long)address == NT_X86_XSTATE) {
        static size_t room = ~(size_t)0;
        struct iovec *buffer = data;
        if (request == PTRACE_GETREGSET) {
            long result = next_ptrace(request, pid, address, buffer);
            if (result == 0 && room == ~(size_t)0)
                room = buffer->iov_len - 8;
            if (buffer->iov_len > room)
                buffer->iov_len = room;
            return result;
        }
        if (request == PTRACE_SETREGSET && buffer->iov_len > room) {
            struct iovec shorter = {buffer->iov_base, room};
            return next_ptrace(request, pid, address, &shorter);
        }
    }
    return next_ptrace(request, pid, address, data);
}
