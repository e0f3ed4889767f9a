/** What something is called, by the service's rule for names. */
export function NameField(props: { name?: string; value: string; set: (name: string) => void; first?: boolean; placeholder?: string }) {
  return (
    <label>
      Name
      <input
        name={props.name ?? "name"}
        required
        autofocus={props.first}
        maxLength={64}
        pattern="[A-Za-z0-9][A-Za-z0-9._\-]*"
        title="Letters, digits, dot, underscore, hyphen; begins with a letter or digit"
        placeholder={props.placeholder}
        autocomplete="off"
        value={props.value}
        onInput={(event) => props.set(event.currentTarget.value)}
      />
    </label>
  );
}
