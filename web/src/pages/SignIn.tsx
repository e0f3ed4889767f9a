import { useSignal } from "@preact/signals";
import { words } from "../api";
import { signIn } from "../state";

export function SignIn() {
  const token = useSignal("");
  const error = useSignal("");
  const busy = useSignal(false);
  return (
    <form
      class="panel sign-in"
      aria-labelledby="sign-in"
      onSubmit={(event) => {
        event.preventDefault();
        busy.value = true;
        signIn(token.value.trim())
          .catch((problem) => (error.value = words(problem)))
          .finally(() => (busy.value = false));
      }}
    >
      <h1 id="sign-in">Sign in</h1>
      <p>
        This service asks for a token, a kind of password. Whoever runs it makes one with <code>gakp token create NAME</code>.
      </p>
      <label>
        Token
        <input
          name="token"
          type="password"
          required
          autocomplete="current-password"
          spellcheck={false}
          value={token.value}
          onInput={(event) => (token.value = event.currentTarget.value)}
        />
      </label>
      <p role="alert" class="bad">
        {error.value}
      </p>
      <button type="submit" class="main" disabled={busy.value}>
        Sign in
      </button>
    </form>
  );
}
